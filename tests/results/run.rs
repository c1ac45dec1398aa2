//! Runs from the user's view: without references, with another split, interrupted, opened elsewhere, rendered along a
//! path, logged to `TensorBoard`.

use nightsplat::results::run::{load_progress, stopped_at};

use crate::common::command::{Folder, exists, file_names, json, refused_with, says, unwrapped};
use crate::common::copy;
use crate::common::prelude::*;

/// A folder with a small dataset in `set`.
fn folder() -> Folder {
    let folder = Folder::empty();
    folder.succeed("synth @set --views 10 --width 48 --height 32");
    folder
}

fn train(out: &str, options: &str) -> String {
    format!("train @set --out @{out} --sh-degree 0 {options}")
}

impl Folder {
    fn steps_of(&self, run: &str) -> Vec<u64> {
        load_progress(&self.path(run)).iter().map(|row| row.step).collect()
    }

    fn count(&self, name: &str) -> usize {
        file_names(self.path(name)).len()
    }
}

#[test]
fn without_references_test_views_are_scored_against_their_targets_with_a_label() {
    let folder = folder();
    folder.succeed(&train("with", "--steps 4 --curve ap3"));
    assert_eq!(folder.json("with/metrics.json").get("against"), None);
    fs::remove_dir_all(folder.path("set/high")).unwrap();
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
        let (message, on_the_way) = folder.run(&train(out, &options), 0);
        says(&unwrapped(&message), &[sentence]);
        says(&on_the_way, &["test views against their"]);
        let metrics = folder.json(&format!("{out}/metrics.json"));
        assert!(metrics["against"].as_str().unwrap().starts_with(label), "{metrics}");
        assert!(metrics["mean"]["psnr"].as_f64().unwrap() > 5.0);
        assert_eq!(json(folder.succeed(&format!("eval @{out} --json"))), metrics);
        says(&folder.succeed(&format!("eval @{out} --save-images")), &[label]);
        assert_eq!(folder.count(&format!("{out}/eval/targets")), 2);
    }
    // With `none`, a photograph is compared with itself.
    let [low, target] = ["set/low/000.png", "plain/eval/targets/000.png"]
        .map(|name| Image::load(folder.path(name)).unwrap());
    assert_eq!(low.data, target.data);
    // The page has the label, too.
    folder.succeed("sweep @set --out @sweep --curves ap3,none --steps 2 --sh-degree 0");
    for file in ["leaderboard.csv", "leaderboard.md", "index.html"] {
        says(&folder.text(&format!("sweep/{file}")), &["against their own pseudo-GT"]);
    }
}

#[test]
fn intermediate_scores_are_rows_and_a_resumed_run_has_each_once() {
    let folder = folder();
    let options = "--eval-every 3 --checkpoint-every 4 --progress none";
    folder.succeed(&train("run", &format!("--steps 6 {options}")));
    assert_eq!(folder.steps_of("run"), [3, 6]);
    folder.succeed(&train("run", &format!("--steps 9 --resume {options}")));
    assert_eq!(folder.steps_of("run"), [3, 6, 9]);
    let text = folder.text("run/evals.csv");
    let header = "step,views,psnr,psnr_channel_mean,ssim,seconds,";
    assert!(text.starts_with(header) && text.lines().count() == 4, "{text}");
    let last = load_progress(&folder.path("run"))[2];
    let metrics = folder.json("run/metrics.json");
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
    let start = |out: &str, options: &str| folder.succeed(&train(out, options));
    let of_short = [
        "8 views of 48x32 to train on",
        "2 test views (as the transforms files say) scored against reference images",
        "points; on ",
        "curve auto: brightness chosen from the photographs",
    ];
    says(&unwrapped(&start("a", "--steps 1 --progress plain")), &of_short);
    // Of eight views, one is held out; of seven, none.
    let of_thirty = [
        "at most 30 steps: training stops early once 1 held-out view has converged, after a cooldown of 10",
        "30 steps are too few for a cooldown of 250 (at most a third)",
        "ended at step 30: all steps are done",
    ];
    let balanced = "--progress plain --preset balanced --set steps";
    says(&unwrapped(&start("d", &format!("{balanced}=30"))), &of_thirty);
    let of_six = "no early stopping: 6 training views are too few to hold one out";
    says(&unwrapped(&start("e", &format!("{balanced}=3 --test-every 3"))), &[of_six]);
    let of_ap3 = ["curve ap3: as requested", "2 test views (every 5th by name, as requested)"];
    let ap3 = "--steps 1 --progress plain --plan none --curve AP3 --test-every 5";
    says(&unwrapped(&start("b", ap3)), &of_ap3);
    let message = start("c", "--steps 1 --progress json --curve none");
    let first = json(message.lines().next().unwrap());
    assert_eq!(first["event"], "started");
    assert_eq!((&first["train_views"], &first["curve"]), (&8.into(), &"none".into()));
    assert!(!first["device"].as_str().unwrap().is_empty());
}

#[test]
fn a_requested_split_is_printed_and_recorded() {
    let folder = folder();
    let (_, message) = folder.run(&train("run", "--steps 2 --test-every 3"), 0);
    says(&message, &["its transforms files split the views", "3"]);
    let views = |run: &str| -> Vec<String> {
        let metrics = folder.json(&format!("{run}/metrics.json"));
        metrics["views"].as_object().unwrap().keys().cloned().collect()
    };
    assert_eq!(views("run"), ["000", "003", "006", "009"]);
    says(&folder.succeed("eval @run"), &["\n006", "\n009"]);
    folder.succeed(&train("all", "--steps 2 --test-every 0"));
    assert!(views("all").is_empty());
    let listed = folder.text("all/views.csv");
    assert_eq!(listed.lines().filter(|line| line.contains(",train,48,32")).count(), 10, "{listed}");
    folder.refused(&train("one", "--test-every 1"), 2, &["test_every (--test-every) is 1"]);
    // A test view without its dark photograph stays a pose: its reference is not trained on.
    fs::remove_file(folder.path("set/low/000.png")).unwrap();
    folder.succeed(&train("pose", "--steps 2 --test-every 0"));
    says(&folder.text("pose/views.csv"), &["000,test,"]);
}

#[test]
fn an_interrupted_run_is_rendered_scored_and_extended_with_a_lower_limit() {
    let folder = folder();
    let options = "--checkpoint-every 5 --curve ap3 --model plain --max-gaussians 4000";
    folder.succeed(&train("run", &format!("--steps 12 {options}")));
    folder.succeed(&train("ten", &format!("--steps 10 {options}")));
    let whole = folder.model("run");
    // As if it had been killed after its last checkpoint.
    for file in ["metrics.json", "done.json"] {
        fs::remove_file(folder.path("run").join(file)).unwrap();
    }
    folder.write("run/model.ply", folder.model("ten"));
    let checkpoint = folder.path("run/checkpoint.safetensors");
    fs::copy(folder.path("run/checkpoint.before.safetensors"), checkpoint).unwrap();
    assert_eq!(stopped_at(&folder.path("run")), Some(10));
    let (printed, message) = folder.run("eval @run --json", 0);
    assert!(message.contains("incomplete, at step 10 of 12"), "{message}");
    let printed = json(printed);
    assert_eq!(printed["steps"], 10);
    assert_eq!(printed["mean"], folder.json("ten/metrics.json")["mean"]);
    let (_, message) = folder.run("render @run --split test --out @shown", 0);
    assert!(message.contains("incomplete, at step 10 of 12"), "{message}");
    assert_eq!(folder.count("shown"), 2);

    folder.succeed(&train("run", &format!("--steps 12 --resume {options}")));
    assert!(folder.model("run") == whole);
    assert_eq!(stopped_at(&folder.path("run")), None);
    let lower = options.replace("4000", "3000");
    let logged = "--eval-every 7 --tensorboard --cache 1M --progress json";
    folder.succeed(&train("run", &format!("--steps 14 --resume {lower} {logged}")));
    assert_eq!(folder.json("run/metrics.json")["steps"], 14);
    let higher = options.replace("4000", "5000");
    let arguments = train("run", &format!("--steps 15 --resume {higher}"));
    folder.refused(&arguments, 3, &["max_gaussians"]);
}

#[test]
fn a_planned_run_is_extended_on_its_original_views() {
    let folder = Folder::empty();
    folder.succeed("synth @set --views 20 --width 32 --height 24");
    let short = "--set steps=6 --checkpoint-every 3 --progress plain";
    says(&folder.succeed(&train("run", short)), &["held-out view"]);
    says(&folder.succeed(&train("run", "--steps 9 --resume --progress none")), &["9 steps"]);
}

#[test]
fn a_model_is_written_with_every_checkpoint() {
    let folder = folder();
    let out = folder.path("run");
    let options = "--steps 100000 --checkpoint-every 5 --curve ap3 --model plain --progress none";
    let mut child = folder.command(&train("run", options));
    let mut child = child.stdout(Stdio::null()).spawn().unwrap();
    while !out.join("model.ply").exists() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(stopped_at(&out).unwrap() >= 5);
    says(&folder.run("eval @run", 0).1, &["incomplete, at step"]);
}

#[test]
fn a_run_is_opened_with_another_copy_of_its_dataset_and_differences_are_reported() {
    let folder = folder();
    folder.succeed(&train("run", "--steps 2"));
    copy(&folder.path("set"), &folder.path("copy"));
    fs::remove_dir_all(folder.path("set")).unwrap();
    folder.refused("eval @run", 3, &["set", "--dataset"]);
    let (printed, message) = folder.run("eval @run --json --dataset @copy", 0);
    assert_eq!(json(printed), folder.json("run/metrics.json"));
    assert!(!message.contains("differs from"), "{message}");
    fs::remove_file(folder.path("copy/low/004.png")).unwrap();
    let (_, message) = folder.run("render @run --split test --out @shown --dataset @copy", 0);
    says(&message, &["differs from", "004,train,48,32"]);
}

/// The images of a path of `run`, as files.
fn flight(folder: &Folder, out: &str, options: &str) -> Vec<PathBuf> {
    folder.succeed(&format!("render @run --out @{out} {options}"));
    file_names(folder.path(out)).iter().map(|name| folder.path(out).join(name)).collect()
}

#[test]
fn the_images_of_a_path_become_a_video() {
    let folder = folder();
    folder.succeed(&train("run", "--steps 30"));
    for way in ["auto", "orbit", "arc", "spiral", "interpolate"] {
        let video = folder.path(way).with_extension("png");
        let options = format!("--path {way} --frames 4 --fps 12 --video @{way}.png");
        let files = flight(&folder, way, &options);
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
    let first = flight(&folder, "test", "--split train").swap_remove(0);
    let frame = folder.path("interpolate/00000.png");
    assert_eq!(Image::load(first).unwrap(), Image::load(frame).unwrap());

    let video = "render @run --out @frames --path orbit --frames 2 --video @orbit.mp4";
    let nowhere = [("PATH", "/nonexistent")];
    let parts = ["orbit.mp4", "needs ffmpeg", "-framerate 30", "*.png"];
    refused_with(&folder.named(video), &nowhere, 1, &parts);
    assert_eq!(folder.count("frames"), 2);
    if exists("ffmpeg") {
        folder.succeed(video);
        folder.succeed("render @run --out @frames --split test --video @views.mp4");
        assert!(folder.read("orbit.mp4").len() > 100 && folder.read("views.mp4").len() > 100);
    }
    // The views of a split are frames, too.
    let views = folder.succeed("render @run --out @frames --split test --video @views.png");
    says(&views, &["views.png"]);
    assert!(folder.read("views.png").windows(4).any(|chunk| chunk == b"acTL"));
    folder.refuses_all(
        "
        2 | render @run --out @frames | --split
        2 | render @run --out @frames --split all --path orbit | --path
        2 | render @run --out @frames --path orbit --format exr --video a.mp4 | --video & exr",
    );
}

#[test]
fn tensorboard_gets_its_events_and_changes_no_bit() {
    let folder = folder();
    let options = "--steps 20 --curve ap3 --model plain --eval-every 10";
    folder.succeed(&train("plain", options));
    folder.succeed(&train("watched", &format!("{options} --tensorboard")));
    assert!(folder.model("plain") == folder.model("watched"));
    let events = file_names(folder.path("watched/tensorboard"));
    assert_eq!(events.len(), 1);
    let bytes = folder.read(&format!("watched/tensorboard/{}", events[0]));
    let tags = ["loss/all", "model/Gaussians", "rates/means", "/PSNR", "view 000/render"];
    says(&String::from_utf8_lossy(&bytes), &[&tags[..], &["all steps are done"]].concat());
    assert!(!folder.path("plain/tensorboard").exists());
}

#[test]
fn options_for_missing_parts_are_refused_with_the_setting_that_enables_them() {
    let folder = folder();
    let message = |out: &str, options: &str| folder.run(&train(out, options), 0).1;
    let plain = message("a", "--steps 1 --model plain --denoiser-channels 8 --depth-is-disparity");
    let parts = ["--denoiser-channels", "no denoiser", "--parts denoiser"];
    says(&plain, &[&parts[..], &["--depth-is-disparity", "no depth"]].concat());
    let with = message("b", "--steps 1 --parts denoiser --denoiser-channels 4 --denoiser-crop 16");
    assert!(!with.contains("no effect"), "{with}");
    let gains = "--steps 1 --set stop.growth_gain=0.3 --set stop.degree_gain=0.02";
    let without = message("c", gains);
    let no_effect = ["stop.growth_gain has no effect", "stop.degree_gain has no effect"];
    says(&without, &[&no_effect[..], &["stop.views=N"]].concat());
    let with = message("d", &format!("{gains} --set stop.views=1"));
    assert!(!with.contains("no effect"), "{with}");
}

#[test]
fn large_photographs_are_resized_to_a_limit_that_is_printed_and_recorded() {
    let folder = folder();
    let views = |out: &str| folder.text(&format!("{out}/views.csv"));
    let (_, message) = folder.run(&train("run", "--steps 2 --max-resolution 24"), 0);
    says(&message, &["48x32 are trained on at 24x16"]);
    says(&views("run"), &["001,train,24,16"]);
    // In addition to another factor, which is the stronger one.
    let (_, message) = folder.run(&train("both", "--steps 2 --max-resolution 40 --downscale 2"), 0);
    assert!(!message.contains("trained on at"), "{message}");
    says(&views("both"), &["001,train,24,16"]);
    folder.succeed(&train("none", "--steps 2 --max-resolution none"));
    says(&views("none"), &["001,train,48,32"]);
    says(&folder.text("none/config.toml"), &["max_resolution = 0"]);
}

#[test]
fn the_model_has_the_same_bits_for_any_cache_size() {
    let folder = folder();
    let model = |out: &str, options: &str| {
        folder.succeed(&train(out, &format!("--steps 30 --progress none {options}")));
        folder.model(out)
    };
    for options in ["--model plain", "--curve ase --parts tonemapper --plan none"] {
        let all = model("all", &format!("{options} --overwrite"));
        for size in ["0", "20K"] {
            let some = model("some", &format!("{options} --overwrite --cache {size}"));
            assert!(all == some, "{options} --cache {size}");
        }
    }
    folder.refused(&train("no", "--cache much"), 2, &["much", "4G"]);
}

/// Reference images and, without them, targets are read again for every score.
#[test]
fn views_have_the_same_scores_for_any_cache_size() {
    let folder = folder();
    let scores = |out: &str, cache: &str| {
        let options = "--steps 6 --eval-every 3 --progress none --model plain --overwrite";
        folder.succeed(&train(out, &format!("{options} --cache {cache}")));
        let trained = folder.json(&format!("{out}/metrics.json"))["views"].clone();
        let scored = json(folder.succeed(&format!("eval @{out} --json --save-images")));
        assert_eq!(scored["views"], trained);
        let on_the_way = load_progress(&folder.path(out));
        (trained, on_the_way.iter().map(|at| (at.step, at.psnr, at.ssim)).collect::<Vec<_>>())
    };
    let against_references = scores("all", "1G");
    assert_eq!(against_references, scores("none", "0"));
    assert_eq!(folder.count("none/eval/references"), 2);
    fs::remove_dir_all(folder.path("set/high")).unwrap();
    let against_targets = scores("all", "1G");
    assert_eq!(against_targets, scores("none", "0"));
    assert!(against_targets != against_references);
    assert_eq!(folder.count("none/eval/targets"), 2);
}
