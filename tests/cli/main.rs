//! The built binary as a shell runs it: its files, its output, and its errors for bad input.
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use nightsplat::kernels;
use nightsplat::networks::lpips::Network;
use nightsplat_photographs::image::{Image, ImageFile};
use nightsplat_photographs::metrics::{self, Scores};
use serde_json::Value;

mod blocks;
#[path = "../common/mod.rs"]
mod common;
mod curves_command;
mod doctor;
mod live;
mod progress;
mod refusals;
mod statistics;
mod stress;
mod sweep;
mod tone_command;
mod tuning;
mod unread;
use common::command::{refused, succeed};
use common::copy;

/// Work shared by the tests, done once: a small dataset and a short run on it.
struct Fixture {
    folder: tempfile::TempDir,
}

const TRAIN: &str = "--steps 40 --seed 3 --sh-degree 1 --curve ap3 --model plain";

fn fixture() -> &'static Fixture {
    static FIXTURE: OnceLock<Fixture> = OnceLock::new();
    FIXTURE.get_or_init(|| {
        let fixture = Fixture { folder: tempfile::tempdir().unwrap() };
        succeed(&format!("synth {} --views 9 --width 64 --height 48", fixture.set()));
        succeed(&format!("train {} --out {} {TRAIN}", fixture.set(), fixture.run()));
        fixture
    })
}

impl Fixture {
    fn set(&self) -> String {
        self.path("set").display().to_string()
    }

    fn run(&self) -> String {
        self.path("run").display().to_string()
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }
}

/// A copy of the fixture's dataset, to damage.
fn copied_set() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    copy(&fixture().path("set"), folder.path());
    folder
}

fn json(path: impl AsRef<Path>) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

fn keys(value: &Value) -> Vec<&str> {
    value.as_object().unwrap().keys().map(String::as_str).collect()
}

fn file_names(folder: impl AsRef<Path>) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<String> =
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_run_directory_has_its_files_and_metrics_have_their_keys() {
    let run = fixture().path("run");
    for name in ["config.toml", "metrics.json", "model.ply", "train.csv"] {
        assert!(run.join(name).is_file(), "{name}");
    }
    assert!(file_names(&run).iter().all(|name| !name.ends_with(".partial")));
    let metrics = json(run.join("metrics.json"));
    let residual_transmittance = "residual_transmittance";
    let known =
        "mean views seconds gaussians steps residual_transmittance spent ended trained_with";
    assert_eq!(keys(&metrics).join(" "), known);
    for made_by in [&metrics["trained_with"], &json(run.join("done.json"))["trained_with"]] {
        assert_eq!(made_by["nightsplat"], env!("CARGO_PKG_VERSION"));
        assert!(!made_by["device"].as_str().unwrap().is_empty(), "{made_by}");
    }
    assert_eq!(keys(&metrics[residual_transmittance]), ["mean", "views"]);
    assert_eq!(keys(&metrics[residual_transmittance]["views"]["008"]), ["mean", "q99"]);
    assert_eq!(keys(&metrics["mean"]), ["psnr", "psnr_channel_mean", "ssim"]);
    assert_eq!(keys(&metrics["views"]), ["000", "008"]);
    assert_eq!(keys(&metrics["views"]["008"]), ["psnr", "psnr_channel_mean", "ssim"]);
    assert_eq!(metrics["steps"], 40);
    assert!(
        metrics["gaussians"].as_u64().unwrap() > 1000 && metrics["seconds"].as_f64().unwrap() > 0.0
    );
    let views = metrics["views"].as_object().unwrap();
    let mean = views.values().map(|view| view["psnr"].as_f64().unwrap()).sum::<f64>() / 2.0;
    assert!((metrics["mean"]["psnr"].as_f64().unwrap() - mean).abs() < 1e-9);

    let log = fs::read_to_string(run.join("train.csv")).unwrap();
    assert_eq!(log.lines().next(), Some("step,view,loss,l1,ssim,gaussians,milliseconds"));
    assert_eq!(log.lines().count(), 41);
    assert!(log.lines().nth(40).unwrap().starts_with("40,"));
    let config = fs::read_to_string(run.join("config.toml")).unwrap();
    assert!(config.starts_with("# trained with {\"nightsplat\":"), "{config}");
    assert!(config.contains("seed = 3") && config.contains("curve = \"ap3\""), "{config}");
    assert!(
        fs::read(run.join("model.ply")).unwrap().starts_with(b"ply\nformat binary_little_endian")
    );
}

#[test]
fn a_seed_gives_one_model_for_any_references() {
    let set = copied_set();
    // Every reference pixel changes, but the model's bits must not.
    for name in file_names(set.path().join("high")) {
        let path = set.path().join("high").join(name);
        let mut image = Image::load(&path).unwrap();
        image.data.iter_mut().for_each(|value| *value = 1.0 - *value);
        image.save_png8(&path).unwrap();
    }
    let (root, run) = (set.path().display(), set.path().join("run"));
    succeed(&format!("train {root} --out {} {TRAIN}", run.display()));
    let first = fs::read(fixture().path("run/model.ply")).unwrap();
    assert!(first == fs::read(run.join("model.ply")).unwrap(), "the references changed the model");
    let means = [fixture().path("run"), run.clone()]
        .map(|run| json(run.join("metrics.json"))["mean"].clone());
    assert_ne!(means[0], means[1], "the scores ought to change with the references");
    // A finished run is the configuration of the next, which replaces it.
    let config = fixture().path("run/config.toml");
    succeed(&format!(
        "train {root} --out {} --config {} --overwrite",
        run.display(),
        config.display()
    ));
    assert!(
        first == fs::read(run.join("model.ply")).unwrap(),
        "the configuration changed the model"
    );
    succeed(
        &format!("train {root} --out {} {TRAIN} --overwrite --seed 4", run.display())
            .replace("--seed 3", ""),
    );
    assert!(
        first != fs::read(run.join("model.ply")).unwrap(),
        "another seed ought to change the model"
    );
}

#[test]
fn eval_agrees_with_train_and_saves_the_scored_images() {
    let fixture = fixture();
    let run = fixture.path("run");
    let printed: Value =
        serde_json::from_str(&succeed(&format!("eval {} --json --save-images", fixture.run())))
            .unwrap();
    let trained = json(run.join("metrics.json"));
    assert_eq!(printed, trained);
    let names = ["000.png", "008.png"];
    assert_eq!(file_names(run.join("eval/renders")), names);
    assert_eq!(file_names(run.join("eval/references")), names);
    for name in ["000", "008"] {
        let load =
            |kind: &str| Image::load(run.join("eval").join(kind).join(name).with_extension("png"));
        let scores =
            Scores::measure(&load("renders").unwrap(), &load("references").unwrap()).unwrap();
        let scored = &trained["views"][name];
        assert!((scores.psnr - scored["psnr"].as_f64().unwrap()).abs() < 0.01, "{name}");
        assert!((scores.ssim - scored["ssim"].as_f64().unwrap()).abs() < 0.001, "{name}");
    }
    let page = fixture.path("eval.html");
    let table = succeed(&format!("eval {} --report {}", fixture.run(), page.display()));
    assert!(table.contains("wrote ") && table.contains("eval.html"), "{table}");
    let page = fs::read_to_string(page).unwrap();
    for part in ["The worst view, 0", "error, times 5", "reference image<", ">loss<", "mean</td>"] {
        assert!(page.contains(part), "no `{part}` in the page");
    }
    let table = succeed(&format!("eval {}", fixture.run()));
    let lines: Vec<&str> = table.lines().collect();
    let verdict = ": 2 test views match the reference images in normal light, with PSNR ";
    assert!(lines[4].contains(verdict), "{table}");
    assert!(lines.last().unwrap().starts_with("next: nightsplat "), "{table}");
    assert!(lines[0].starts_with("view") && lines[0].contains("channel mean"), "{table}");
    let mean = format!("{:.2}", trained["mean"]["psnr"].as_f64().unwrap());
    assert!(lines[3].starts_with("mean") && lines[3].contains(&mean), "{table}");
    assert!(lines[..4].iter().all(|line| line.len() == lines[0].len()), "not aligned:\n{table}");
}

#[test]
fn eval_adds_ssim_with_a_uniform_window_on_request() {
    let fixture = fixture();
    let eval = format!("eval {} --uniform-ssim", fixture.run());
    let scores: Value =
        serde_json::from_str(&succeed(&format!("{eval} --json --save-images"))).unwrap();
    for name in ["000", "008"] {
        let path = |kind: &str| fixture.path("run").join("eval").join(kind).join(name);
        let load = |kind: &str| Image::load(path(kind).with_extension("png")).unwrap();
        let expected = metrics::ssim_uniform(&load("renders"), &load("references")).unwrap();
        let scored = scores["views"][name]["ssim_uniform"].as_f64().unwrap();
        assert!((scored - expected).abs() < 1e-4, "{name}: {scored}, not {expected}");
    }
    assert!(succeed(&eval).lines().next().unwrap().contains("SSIM, uniform"));
}

#[test]
fn eval_scores_lpips_with_given_weights() {
    let fixture = fixture();
    let weights = fixture.path("weights.safetensors");
    let eval = format!("eval {} --lpips {}", fixture.run(), weights.display());
    for (network, range, key, title) in [
        (Network::Alex, "signed", "lpips", "LPIPS "),
        (Network::Alex, "unit", "lpips_alex_unit", "LPIPS alex unit"),
        (Network::Vgg, "signed", "lpips_vgg_signed", "LPIPS vgg signed"),
        (Network::Vgg, "unit", "lpips_vgg_unit", "LPIPS vgg unit"),
    ] {
        common::lpips::write(network, &weights, |_, _, _| {});
        let eval = match range {
            "signed" => eval.clone(),
            _ => format!("{eval} --lpips-range {range}"),
        };
        let scores: Value = serde_json::from_str(&succeed(&format!("{eval} --json"))).unwrap();
        let of = |name: &str| scores["views"][name][key].as_f64().unwrap();
        let mean = scores["mean"][key].as_f64().unwrap();
        assert!((mean - (of("000") + of("008")) / 2.0).abs() < 1e-12 && mean > 0.0, "{scores}");
        let message = serde_json::json!({ "network": network.name(), "range": range, "key": key });
        assert_eq!(scores["lpips"], message);
        let keys = keys(&scores["mean"]);
        assert_eq!(keys.iter().filter(|key| key.starts_with("lpips")).count(), 1, "{keys:?}");
        let table = succeed(&eval);
        let header = format!("{} ", table.lines().next().unwrap());
        assert!(header.contains(title) && table.contains(&format!("{mean:.4}")), "{table}");
    }
    fs::write(&weights, "no weights").unwrap();
    refused(&eval, 3, &["weights.safetensors", "safetensors"]);
    let without = format!("eval {} --lpips-range unit", fixture.run());
    refused(&without, 2, &["--lpips <WEIGHTS>"]);
    assert!(json(fixture.path("run/metrics.json")).get("lpips").is_none(), "train scores no LPIPS");
}

#[test]
fn a_set_without_references_and_photographs_of_test_views_scores_nothing() {
    let set = copied_set();
    fs::remove_dir_all(set.path().join("high")).unwrap();
    for name in ["000", "008"] {
        fs::remove_file(set.path().join("low").join(name).with_extension("png")).unwrap();
    }
    let (root, run) = (set.path().display(), set.path().join("run"));
    succeed(&format!("train {root} --out {} --steps 2", run.display()));
    assert_eq!(json(run.join("metrics.json"))["mean"], Value::Null);
    let (printed, message) = common::command::run(&format!("eval {} --json", run.display()), 0);
    let printed: Value = serde_json::from_str(&printed).unwrap();
    assert_eq!((&printed["mean"], keys(&printed["views"]).len()), (&Value::Null, 0));
    assert!(message.contains("no test view has a reference image or a photograph"), "{message}");
    assert_eq!(succeed(&format!("eval {}", run.display())).lines().count(), 2);
}

#[test]
fn every_pose_of_a_split_is_rendered_with_or_without_an_image() {
    let set = copied_set();
    // A test view that has only its pose.
    for folder in ["low", "high"] {
        fs::remove_file(set.path().join(folder).join("008.png")).unwrap();
    }
    let run = set.path().join("run");
    fs::create_dir(&run).unwrap();
    fs::copy(fixture().path("run/model.ply"), run.join("model.ply")).unwrap();
    let config = fs::read_to_string(fixture().path("run/config.toml")).unwrap();
    fs::write(
        run.join("config.toml"),
        config.replace(&fixture().set(), &set.path().display().to_string()),
    )
    .unwrap();
    let render = |split: &str, format: &str| {
        let out = run.join(split);
        succeed(&format!(
            "render {} --split {split} --out {} --format {format}",
            run.display(),
            out.display()
        ));
        (file_names(&out), out)
    };
    let (names, exr) = render("all", "exr");
    assert_eq!(names, (0..9).map(|view| format!("{view:03}.exr")).collect::<Vec<_>>());
    let (names, png) = render("test", "png");
    assert_eq!(names, ["000.png", "008.png"]);
    let (names, _) = render("train", "png");
    assert_eq!(names.len(), 7);
    for name in ["000", "008"] {
        let [float, byte] = [exr.join(format!("{name}.exr")), png.join(format!("{name}.png"))]
            .map(|path| Image::load(path).unwrap());
        assert_eq!((byte.width, byte.height), (64, 48));
        for (float, byte) in float.data.iter().zip(&byte.data) {
            assert!((float.clamp(0.0, 1.0) - byte).abs() < 0.51 / 255.0, "{float} {byte}");
        }
    }
}

#[test]
fn renders_never_replace_the_photographs() {
    let (low, run) = (fixture().path("set/low"), fixture().run());
    let before = fs::read(low.join("001.png")).unwrap();
    let arguments = format!("render {run} --split all --out {}", low.display());
    refused(&arguments, 1, &["low", "inside the dataset", "--out"]);
    assert_eq!(before, fs::read(low.join("001.png")).unwrap());
}

#[test]
fn doctor_lists_the_devices_and_their_features() {
    let report = succeed("doctor");
    assert!(report.contains("yes  timelineSemaphore") && report.contains("Vulkan 1."), "{report}");
    assert!(report.contains("ready: trains on ") && report.contains("colmap  "), "{report}");
}

#[test]
fn bench_checks_and_times_every_kernel_of_a_step_and_lists_the_others() {
    let small = "bench --json --repeats 1 --width 64 --height 48 --gaussians 300";
    let printed: Value = serde_json::from_str(&succeed(small)).unwrap();
    assert!(
        !printed["device"].as_str().unwrap().is_empty()
            && !printed["driver"].as_str().unwrap().is_empty()
    );
    assert!(printed["step_ms"].as_f64().unwrap() > 0.0);
    assert!(printed["groups"]["blend_forward"].as_f64().unwrap() > 0.0);
    let errors = printed["errors"].as_object().unwrap();
    assert!(errors.values().all(|error| error.as_f64().unwrap() <= 1.0), "{errors:?}");
    assert!(keys(&printed["kernels"]).iter().all(|kernel| errors.contains_key(*kernel)));
    let not_covered = printed["not_covered"].as_array().unwrap().iter();
    let not_covered: Vec<&str> = not_covered.map(|name| name.as_str().unwrap()).collect();
    // SSIM is one kernel on a CPU and two on a GPU, where Adam updates whole Gaussians also in 32 bits. The sort of
    // each tile runs only where `bench --tune` has chosen it.
    let by_kind = |name: &&str| name.starts_with("ssim") || *name == "adam_gaussian";
    let everywhere = not_covered.iter().copied().filter(|name| !by_kind(name));
    let elsewhere = "\
        conv3x3_half conv3x3_weight_gradient_half conv_strided \
        depth_limits expose expose_backward exposure_center exposure_gradient first_not_finite lamp_backward \
        lamp_gradient largest_magnitude mask_gradient mask_render max_pool motion_vectors pack_map pack_pixels \
        pack_weights parameter_terms photograph_light pick_splats place_pairs self_test smoothing_floor sort_tiles \
        tile_begins";
    assert_eq!(everywhere.collect::<Vec<_>>().join(" "), elsewhere);
    let mut named = [keys(&printed["errors"]), not_covered].concat();
    named.sort_unstable();
    assert_eq!(named, kernels::NAMES);
}

#[test]
fn bench_times_a_trained_model_in_the_storage_of_training() {
    let fixture = fixture();
    let run = fixture.run();
    let bench = |arguments: &str| -> Value {
        let options = "--json --unchecked --repeats 1 --steady 2";
        serde_json::from_str(&succeed(&format!("bench {options} {arguments}"))).unwrap()
    };
    let of_run = bench(&format!("{run} --precision 16"));
    let kernels = keys(&of_run["kernels"]);
    assert!(kernels.contains(&"adam_gaussian"), "{kernels:?}");
    assert_eq!(
        (&of_run["scene"], &of_run["precision"]["rest"]),
        (&run.as_str().into(), &"16".into())
    );
    let of_file = bench(&format!("{run}/model.ply --width 32 --height 40"));
    assert_eq!((&of_file["width"], &of_file["height"]), (&32.into(), &40.into()));
    let counts = [&of_run["gaussians"], &of_file["gaussians"]].map(|count| count.as_u64().unwrap());
    assert!(counts[0] > 0 && counts[0] == counts[1], "{counts:?}");
    for seen in [&of_run, &of_file] {
        assert!(seen["intersections"].as_u64().unwrap() > counts[0] / 2, "{seen}");
    }
}

#[test]
fn demo_changes_no_foreign_folder() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("thesis.tex"), "mine").unwrap();
    refused(&format!("demo --out {}", folder.path().display()), 1, &["not empty", "--out"]);
    assert_eq!(file_names(folder.path()), ["thesis.tex"]);
}

#[test]
fn demo_is_a_sweep_of_four_curves_that_continues_and_links_the_model() {
    let folder = tempfile::tempdir().unwrap();
    let demo = format!("demo --out {} --steps 20", folder.path().display());
    let table = succeed(&demo);
    for curve in ["auto", "linear", "ase", "ap3"] {
        assert!(folder.path().join(format!("curve={curve}/model.ply")).is_file(), "{table}");
    }
    let page = fs::read_to_string(folder.path().join("index.html")).unwrap();
    assert!(page.contains("exposed") && page.contains("data:image/png"));
    assert!(page.contains("<a href=\"curve=auto/model.html\">"));
    // First the flight, then pictures, then scores.
    let order = ["<iframe", "data:image/png", "<table"].map(|part| page.find(part).unwrap());
    assert!(order.is_sorted(), "{order:?}");
    assert!(folder.path().join("curve=auto/model.html").is_file());
    assert_eq!(succeed(&demo), table, "nothing is trained twice");
}

/// A reader that ends early, as `head` does.
#[test]
fn a_closed_pipe_ends_a_command_quietly() {
    let set = fixture().set();
    for arguments in
        [&format!("tone apply {set} --json"), &format!("diagnose {set}"), "doctor", "tone list"]
    {
        let mut command = common::command::command(arguments);
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = command.stdout(writer).stderr(std::process::Stdio::piped()).output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && !message.contains("error"), "{arguments}: {message}");
    }
}

#[test]
fn man_pages_keep_the_lines_of_their_examples() {
    let folder = tempfile::tempdir().unwrap();
    succeed(&format!("man {}", folder.path().display()));
    let page = fs::read_to_string(folder.path().join("nightsplat-train.1")).unwrap();
    let (_, examples) = page.split_once(".SH EXAMPLES\n.nf\n").unwrap();
    assert!(examples.lines().any(|line| line.contains("nightsplat train photos")), "{examples}");
    assert!(examples.ends_with(".fi\n") && page.contains("ssim"), "{page}");
}

#[test]
fn help_fits_a_screen_and_help_all_has_every_option_in_lines_that_fit() {
    let commands = ",train,diagnose,pose,eval,render,export,view,tone,tone list,tone apply,tone fit,\
        sweep,synth,demo,doctor,bench,check";
    for command in commands.split(',') {
        let (short, all) =
            (succeed(&format!("{command} -h")), succeed(&format!("{command} --help-all")));
        assert!(all.lines().all(|line| line.chars().count() < 100), "{all}");
        assert!(short.lines().count() <= if command.is_empty() { 60 } else { 40 }, "{short}");
    }
    let help = succeed("--help");
    let mut first_words = commands.split(',').filter_map(|command| command.split(' ').next());
    assert!(first_words.all(|word| help.contains(word)), "{help}");
    // The first two columns are names; the commands for developers follow below.
    let listed = help.lines().skip_while(|line| *line != "Commands:").skip(1);
    let listed = listed.take_while(|line| !line.is_empty());
    let names: Vec<&str> = listed
        .filter(|line| line.starts_with("  ") && !line.starts_with("   "))
        .filter_map(|line| line.split_whitespace().next())
        .collect();
    assert!(
        names.len() <= 15 && names.contains(&"train") && !names.contains(&"synth"),
        "{names:?}"
    );
    let (short, all) = (succeed("train -h"), succeed("train --help-all"));
    assert_eq!(short, succeed("train --help"));
    for part in ["--preset", "--max-vram", "Example:", "--help-all"] {
        assert!(short.contains(part), "no `{part}` in {short}");
    }
    assert!(!short.contains("--ssim-weight"), "{short}");
    for group in ["Photographs:", "Tone curve:", "Model:", "Logs and checks:"] {
        assert!(all.contains(&format!("\n{group}\n")), "no `{group}` in {all}");
    }
    for option in "--curve --gain --theta --steps --downscale --seed --sh-degree --ssim-weight --max-gaussians \
                   --background --reference --device --config --eval-every --out --overwrite --max-resolution --cache \
                   --test-every --tensorboard"
        .split_whitespace()
    {
        assert!(all.contains(option), "{option}");
    }
}
