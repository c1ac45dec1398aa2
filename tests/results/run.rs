//! Runs from the user's view: without references, with another split, interrupted, opened elsewhere, rendered along a
//! path, logged to `TensorBoard`.

use std::fs;
use std::path::{Path, PathBuf};

use nightsplat::results::run::{load_progress, stopped_at};
use nightsplat_photographs::image::{Image, ImageFile};
use serde_json::Value;

use crate::common::command::{command, refused, refused_with, run, succeed, unwrapped};
use crate::common::copy;

/// A folder with a small dataset in `set`.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let set = folder.path().join("set").display().to_string();
    succeed(&format!("synth {set} --views 10 --width 48 --height 32"));
    folder
}

fn json(path: impl AsRef<Path>) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

fn train(folder: &Path, out: &str, options: &str) -> String {
    let (set, out) = (folder.join("set"), folder.join(out));
    format!("train {} --out {} --sh-degree 0 {options}", set.display(), out.display())
}

fn file_count(folder: impl AsRef<Path>) -> usize {
    fs::read_dir(folder).unwrap().count()
}

#[test]
fn without_references_test_views_are_scored_against_their_targets_with_a_label() {
    let folder = folder();
    let path = |name: &str| folder.path().join(name);
    succeed(&train(folder.path(), "with", "--steps 4 --curve ap3"));
    assert_eq!(json(path("with/metrics.json")).get("against"), None);
    fs::remove_dir_all(path("set/high")).unwrap();
    for (out, curve, label, sentence) in [
        (
            "tone-mapped",
            "--curve ap3",
            "against their own pseudo-GT",
            "2 test views match their targets, the brightened photographs, with PSNR ",
        ),
        (
            "plain",
            "--curve none",
            "against the photographs themselves",
            "2 test views match the photographs themselves, with PSNR ",
        ),
    ] {
        let options = format!("--steps 4 --eval-every 2 --progress plain {curve}");
        let (message, on_the_way) = run(&train(folder.path(), out, &options), 0);
        assert!(unwrapped(&message).contains(sentence), "{message}");
        assert!(on_the_way.contains("test views against their"), "{on_the_way}");
        let metrics = json(path(out).join("metrics.json"));
        assert!(metrics["against"].as_str().unwrap().starts_with(label), "{metrics}");
        assert!(metrics["mean"]["psnr"].as_f64().unwrap() > 5.0);
        let printed: Value =
            serde_json::from_str(&succeed(&format!("eval {} --json", path(out).display())))
                .unwrap();
        assert_eq!(printed, metrics);
        let table = succeed(&format!("eval {} --save-images", path(out).display()));
        assert!(table.contains(label), "{table}");
        assert_eq!(file_count(path(out).join("eval/targets")), 2);
    }
    // With `none`, a photograph is compared with itself.
    let [low, target] = ["set/low/000.png", "plain/eval/targets/000.png"].map(path);
    assert_eq!(Image::load(low).unwrap().data, Image::load(target).unwrap().data);
    // The page has the label, too.
    let sweep = path("sweep").display().to_string();
    let set = path("set").display().to_string();
    succeed(&format!("sweep {set} --out {sweep} --curves ap3,none --steps 2 --sh-degree 0"));
    for file in ["leaderboard.csv", "leaderboard.md", "index.html"] {
        let text = fs::read_to_string(path("sweep").join(file)).unwrap();
        assert!(text.contains("against their own pseudo-GT"), "{file}: {text}");
    }
}

#[test]
fn intermediate_scores_are_rows_and_a_resumed_run_has_each_once() {
    let folder = folder();
    let path = |name: &str| folder.path().join(name);
    let options = "--eval-every 3 --checkpoint-every 4 --progress none";
    succeed(&train(folder.path(), "run", &format!("--steps 6 {options}")));
    let steps =
        |run: &Path| -> Vec<u64> { load_progress(run).iter().map(|row| row.step).collect() };
    assert_eq!(steps(&path("run")), [3, 6]);
    succeed(&train(folder.path(), "run", &format!("--steps 9 --resume {options}")));
    assert_eq!(steps(&path("run")), [3, 6, 9]);
    let text = fs::read_to_string(path("run/evals.csv")).unwrap();
    let header = "step,views,psnr,psnr_channel_mean,ssim,seconds,";
    assert!(text.starts_with(header) && text.lines().count() == 4, "{text}");
    let last = load_progress(&path("run"))[2];
    let metrics = json(path("run/metrics.json"));
    assert_eq!(last.views, 2);
    for (name, value) in
        [("psnr", last.psnr), ("psnr_channel_mean", last.psnr_channel_mean), ("ssim", last.ssim)]
    {
        assert_eq!(metrics["mean"][name].as_f64().unwrap(), value, "{name}");
    }
}

#[test]
fn a_run_prints_a_summary_at_its_start() {
    let folder = folder();
    let start = |out: &str, options: &str| succeed(&train(folder.path(), out, options));
    let message = unwrapped(&start("a", "--steps 1 --progress plain"));
    for part in [
        "8 views of 48x32 to train on",
        "2 test views (as the transforms files say) scored against reference images",
        "points; on ",
        "curve auto: brightness chosen from the photographs",
    ] {
        assert!(message.contains(part), "no `{part}` in: {message}");
    }
    // Of eight views, one is held out; of seven, none.
    let message = unwrapped(&start("d", "--progress plain --preset balanced --set steps=30"));
    for part in [
        "at most 30 steps: training stops early once 1 held-out view has converged, after a cooldown of 10",
        "30 steps are too few for a cooldown of 250 (at most a third)",
    ] {
        assert!(message.contains(part), "no `{part}` in: {message}");
    }
    assert!(message.contains("ended at step 30: all steps are done"), "{message}");
    let message =
        unwrapped(&start("e", "--progress plain --preset balanced --set steps=3 --test-every 3"));
    assert!(
        message.contains("no early stopping: 6 training views are too few to hold one out"),
        "{message}"
    );
    let message =
        unwrapped(&start("b", "--steps 1 --progress plain --plan none --curve AP3 --test-every 5"));
    assert!(message.contains("curve ap3: as requested"), "{message}");
    assert!(message.contains("2 test views (every 5th by name, as requested)"), "{message}");
    let message = start("c", "--steps 1 --progress json --curve none");
    let first: Value = serde_json::from_str(message.lines().next().unwrap()).unwrap();
    assert_eq!(first["event"], "started");
    assert_eq!((&first["train_views"], &first["curve"]), (&8.into(), &"none".into()));
    assert!(!first["device"].as_str().unwrap().is_empty());
}

#[test]
fn a_requested_split_is_printed_and_recorded() {
    let folder = folder();
    let path = |name: &str| folder.path().join(name);
    let (_, message) = run(&train(folder.path(), "run", "--steps 2 --test-every 3"), 0);
    assert!(
        message.contains("its transforms files split the views") && message.contains("3"),
        "{message}"
    );
    let views = |run: &str| -> Vec<String> {
        let metrics = json(path(run).join("metrics.json"));
        metrics["views"].as_object().unwrap().keys().cloned().collect()
    };
    assert_eq!(views("run"), ["000", "003", "006", "009"]);
    let table = succeed(&format!("eval {}", path("run").display()));
    assert!(table.contains("\n006") && table.contains("\n009"), "{table}");
    succeed(&train(folder.path(), "all", "--steps 2 --test-every 0"));
    assert!(views("all").is_empty());
    let listed = fs::read_to_string(path("all/views.csv")).unwrap();
    assert_eq!(listed.lines().filter(|line| line.contains(",train,48,32")).count(), 10, "{listed}");
    refused(&train(folder.path(), "one", "--test-every 1"), 2, &["test_every (--test-every) is 1"]);
    // A test view without its dark photograph stays a pose: its reference is not trained on.
    fs::remove_file(path("set/low/000.png")).unwrap();
    succeed(&train(folder.path(), "pose", "--steps 2 --test-every 0"));
    let listed = fs::read_to_string(path("pose/views.csv")).unwrap();
    assert!(listed.contains("000,test,"), "{listed}");
}

#[test]
fn an_interrupted_run_is_rendered_scored_and_extended_with_a_lower_limit() {
    let folder = folder();
    let path = |name: &str| folder.path().join(name);
    let options = "--checkpoint-every 5 --curve ap3 --model plain --max-gaussians 4000";
    succeed(&train(folder.path(), "run", &format!("--steps 12 {options}")));
    succeed(&train(folder.path(), "ten", &format!("--steps 10 {options}")));
    let model = |run: &str| fs::read(path(run).join("model.ply")).unwrap();
    let whole = model("run");
    // As if it had been killed after its last checkpoint.
    for file in ["metrics.json", "done.json"] {
        fs::remove_file(path("run").join(file)).unwrap();
    }
    fs::copy(path("ten/model.ply"), path("run/model.ply")).unwrap();
    let checkpoint = path("run/checkpoint.safetensors");
    fs::copy(path("run/checkpoint.before.safetensors"), checkpoint).unwrap();
    assert_eq!(stopped_at(&path("run")), Some(10));
    let run_folder = path("run").display().to_string();
    let (printed, message) = run(&format!("eval {run_folder} --json"), 0);
    assert!(message.contains("incomplete, at step 10 of 12"), "{message}");
    let printed: Value = serde_json::from_str(&printed).unwrap();
    assert_eq!(printed["steps"], 10);
    assert_eq!(printed["mean"], json(path("ten/metrics.json"))["mean"]);
    let shown = path("shown").display().to_string();
    let (_, message) = run(&format!("render {run_folder} --split test --out {shown}"), 0);
    assert!(
        message.contains("incomplete, at step 10 of 12") && file_count(&shown) == 2,
        "{message}"
    );

    succeed(&train(folder.path(), "run", &format!("--steps 12 --resume {options}")));
    assert!(model("run") == whole);
    assert_eq!(stopped_at(&path("run")), None);
    let lower = options.replace("4000", "3000");
    let logged = "--eval-every 7 --tensorboard --cache 1M --progress json";
    succeed(&train(folder.path(), "run", &format!("--steps 14 --resume {lower} {logged}")));
    assert_eq!(json(path("run/metrics.json"))["steps"], 14);
    let higher = options.replace("4000", "5000");
    let arguments = train(folder.path(), "run", &format!("--steps 15 --resume {higher}"));
    refused(&arguments, 3, &["max_gaussians"]);
}

#[test]
fn a_planned_run_is_extended_on_its_original_views() {
    let folder = tempfile::tempdir().unwrap();
    let set = folder.path().join("set").display().to_string();
    succeed(&format!("synth {set} --views 20 --width 32 --height 24"));
    let short = "--set steps=6 --checkpoint-every 3 --progress plain";
    let message = succeed(&train(folder.path(), "run", short));
    assert!(message.contains("held-out view"), "{message}");
    let message = succeed(&train(folder.path(), "run", "--steps 9 --resume --progress none"));
    assert!(message.contains("9 steps"), "{message}");
}

#[test]
fn a_model_is_written_with_every_checkpoint() {
    let folder = folder();
    let out = folder.path().join("run");
    let options = "--steps 100000 --checkpoint-every 5 --curve ap3 --model plain --progress none";
    let mut child = command(&train(folder.path(), "run", options));
    let mut child = child.stdout(std::process::Stdio::null()).spawn().unwrap();
    while !out.join("model.ply").exists() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(stopped_at(&out).unwrap() >= 5);
    let (_, message) = run(&format!("eval {}", out.display()), 0);
    assert!(message.contains("incomplete, at step"), "{message}");
}

#[test]
fn a_run_is_opened_with_another_copy_of_its_dataset_and_differences_are_reported() {
    let folder = folder();
    let path = |name: &str| folder.path().join(name);
    succeed(&train(folder.path(), "run", "--steps 2"));
    copy(&path("set"), &path("copy"));
    fs::remove_dir_all(path("set")).unwrap();
    let [run_folder, copied, shown] =
        ["run", "copy", "shown"].map(|name| path(name).display().to_string());
    refused(&format!("eval {run_folder}"), 3, &["set", "--dataset"]);
    let (printed, message) = run(&format!("eval {run_folder} --json --dataset {copied}"), 0);
    let printed: Value = serde_json::from_str(&printed).unwrap();
    assert_eq!(printed, json(path("run/metrics.json")));
    assert!(!message.contains("differs from"), "{message}");
    fs::remove_file(path("copy/low/004.png")).unwrap();
    let arguments = format!("render {run_folder} --split test --out {shown} --dataset {copied}");
    let (_, message) = run(&arguments, 0);
    assert!(message.contains("differs from") && message.contains("004,train,48,32"), "{message}");
}

/// The images of a path, as files.
fn flight(run: &Path, out: &Path, options: &str) -> Vec<PathBuf> {
    succeed(&format!("render {} --out {} {options}", run.display(), out.display()));
    let mut files: Vec<PathBuf> =
        fs::read_dir(out).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

#[test]
fn the_images_of_a_path_become_a_video() {
    let folder = folder();
    let path = |name: &str| folder.path().join(name);
    succeed(&train(folder.path(), "run", "--steps 30"));
    for way in ["auto", "orbit", "arc", "spiral", "interpolate"] {
        let video = path(way).with_extension("png");
        let options = format!("--path {way} --frames 4 --fps 12 --video {}", video.display());
        let files = flight(&path("run"), &path(way), &options);
        assert_eq!(files.len(), 4, "{way}");
        assert!(files[0].ends_with("00000.png") && files[3].ends_with("00003.png"));
        let [first, last] = [&files[0], &files[3]].map(|file| Image::load(file).unwrap());
        assert_eq!((first.width, first.height), (48, 32));
        assert!(first.data != last.data && first.data.iter().any(|&value| value > 0.1), "{way}");
        // Viewers without support for animation show the first frame.
        assert_eq!(Image::load(&video).unwrap(), first);
        let bytes = fs::read(&video).unwrap();
        let chunks = |name: &[u8]| bytes.windows(4).filter(|window| *window == name).count();
        assert_eq!((chunks(b"acTL"), chunks(b"fcTL")), (1, 4));
    }
    // The path starts at the first training camera.
    let first = flight(&path("run"), &path("test"), "--split train").swap_remove(0);
    let frame = path("interpolate/00000.png");
    assert_eq!(Image::load(first).unwrap(), Image::load(frame).unwrap());

    let [run_folder, out] = ["run", "frames"].map(|name| path(name).display().to_string());
    let render = format!("render {run_folder} --out {out}");
    let video =
        format!("{render} --path orbit --frames 2 --video {}/orbit.mp4", folder.path().display());
    let nowhere = [("PATH", "/nonexistent")];
    let parts = ["orbit.mp4", "needs ffmpeg", "-framerate 30", "*.png"];
    refused_with(&video, &nowhere, 1, &parts);
    assert_eq!(file_count(&out), 2);
    if crate::common::command::exists("ffmpeg") {
        succeed(&video);
        assert!(fs::metadata(path("orbit.mp4")).unwrap().len() > 100);
        let views = format!("{render} --split test --video {}/views.mp4", folder.path().display());
        succeed(&views);
        assert!(fs::metadata(path("views.mp4")).unwrap().len() > 100);
    }
    // The views of a split are frames, too.
    let views = format!("{render} --split test --video {}/views.png", folder.path().display());
    assert!(succeed(&views).contains("views.png"));
    assert!(fs::read(path("views.png")).unwrap().windows(4).any(|chunk| chunk == b"acTL"));
    refused(&render, 2, &["--split"]);
    refused(&format!("{render} --split all --path orbit"), 2, &["--path"]);
    refused(&format!("{render} --path orbit --format exr --video a.mp4"), 2, &["--video", "exr"]);
}

#[test]
fn tensorboard_gets_its_events_and_changes_no_bit() {
    let folder = folder();
    let path = |name: &str| folder.path().join(name);
    let options = "--steps 20 --curve ap3 --model plain --eval-every 10";
    succeed(&train(folder.path(), "plain", options));
    succeed(&train(folder.path(), "watched", &format!("{options} --tensorboard")));
    let model = |run: &str| fs::read(path(run).join("model.ply")).unwrap();
    assert!(model("plain") == model("watched"));
    let events: Vec<PathBuf> = fs::read_dir(path("watched/tensorboard"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    assert_eq!(events.len(), 1);
    let bytes = fs::read(&events[0]).unwrap();
    let has = |text: &str| bytes.windows(text.len()).any(|window| window == text.as_bytes());
    for tag in [
        "loss/all",
        "model/Gaussians",
        "rates/means",
        "/PSNR",
        "view 000/render",
        "all steps are done",
    ] {
        assert!(has(tag), "{tag}");
    }
    assert!(!path("plain/tensorboard").exists());
}

#[test]
fn options_for_missing_parts_are_refused_with_the_setting_that_enables_them() {
    let folder = folder();
    let message = |out: &str, options: &str| run(&train(folder.path(), out, options), 0).1;
    let plain = message("a", "--steps 1 --model plain --denoiser-channels 8 --depth-is-disparity");
    for part in [
        "--denoiser-channels",
        "no denoiser",
        "--parts denoiser",
        "--depth-is-disparity",
        "no depth",
    ] {
        assert!(plain.contains(part), "no `{part}` in: {plain}");
    }
    let with = message("b", "--steps 1 --parts denoiser --denoiser-channels 4 --denoiser-crop 16");
    assert!(!with.contains("no effect"), "{with}");
    let gains = "--steps 1 --set stop.growth_gain=0.3 --set stop.degree_gain=0.02";
    let without = message("c", gains);
    for gain in ["stop.growth_gain has no effect", "stop.degree_gain has no effect", "stop.views=N"]
    {
        assert!(without.contains(gain), "no `{gain}` in: {without}");
    }
    let with = message("d", &format!("{gains} --set stop.views=1"));
    assert!(!with.contains("no effect"), "{with}");
}

#[test]
fn large_photographs_are_resized_to_a_limit_that_is_printed_and_recorded() {
    let folder = folder();
    let path = |name: &str| folder.path().join(name);
    let views = |out: &str| fs::read_to_string(path(out).join("views.csv")).unwrap();
    let (_, message) = run(&train(folder.path(), "run", "--steps 2 --max-resolution 24"), 0);
    assert!(message.contains("48x32 are trained on at 24x16"), "{message}");
    assert!(views("run").contains("001,train,24,16"), "{}", views("run"));
    // In addition to another factor, which is the stronger one.
    let (_, message) =
        run(&train(folder.path(), "both", "--steps 2 --max-resolution 40 --downscale 2"), 0);
    assert!(
        !message.contains("trained on at") && views("both").contains("001,train,24,16"),
        "{message}"
    );
    succeed(&train(folder.path(), "none", "--steps 2 --max-resolution none"));
    assert!(views("none").contains("001,train,48,32"));
    let config = fs::read_to_string(path("none/config.toml")).unwrap();
    assert!(config.contains("max_resolution = 0"), "{config}");
}

#[test]
fn the_model_has_the_same_bits_for_any_cache_size() {
    let folder = folder();
    let model = |out: &str, options: &str| {
        succeed(&train(folder.path(), out, &format!("--steps 30 --progress none {options}")));
        fs::read(folder.path().join(out).join("model.ply")).unwrap()
    };
    for options in ["--model plain", "--curve ase --parts tonemapper --plan none"] {
        let all = model("all", &format!("{options} --overwrite"));
        for size in ["0", "20K"] {
            let some = model("some", &format!("{options} --overwrite --cache {size}"));
            assert!(all == some, "{options} --cache {size}");
        }
    }
    refused(&train(folder.path(), "no", "--cache much"), 2, &["much", "4G"]);
}

/// Reference images and, without them, targets are read again for every score.
#[test]
fn views_have_the_same_scores_for_any_cache_size() {
    let folder = folder();
    let path = |name: &str| folder.path().join(name);
    let scores = |out: &str, cache: &str| {
        let options = "--steps 6 --eval-every 3 --progress none --model plain --overwrite";
        succeed(&train(folder.path(), out, &format!("{options} --cache {cache}")));
        let trained = json(path(out).join("metrics.json"))["views"].clone();
        let printed = succeed(&format!("eval {} --json --save-images", path(out).display()));
        let scored: Value = serde_json::from_str(&printed).unwrap();
        assert_eq!(scored["views"], trained);
        let on_the_way = load_progress(&path(out));
        (trained, on_the_way.iter().map(|at| (at.step, at.psnr, at.ssim)).collect::<Vec<_>>())
    };
    let against_references = scores("all", "1G");
    assert_eq!(against_references, scores("none", "0"));
    assert_eq!(file_count(path("none/eval/references")), 2);
    fs::remove_dir_all(path("set/high")).unwrap();
    let against_targets = scores("all", "1G");
    assert_eq!(against_targets, scores("none", "0"));
    assert!(against_targets != against_references);
    assert_eq!(file_count(path("none/eval/targets")), 2);
}
