//! The built binary as a shell runs it: its files, its output, and its errors for bad input.
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use nightsplat::kernels;
use nightsplat::networks::lpips::Network;
use nightsplat_photographs::metrics;

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
use common::command::{Folder, file_names, json, says, succeed};
use common::copy;

use crate::common::prelude::*;

const TRAIN: &str = "--steps 40 --seed 3 --sh-degree 1 --curve ap3 --model plain";

/// A small dataset in `set` and a short run on it in `run`, shared by the tests.
fn fixture() -> &'static Folder {
    static FIXTURE: OnceLock<Folder> = OnceLock::new();
    FIXTURE.get_or_init(|| {
        let folder = Folder::empty();
        folder.succeed("synth @set --views 9 --width 64 --height 48");
        folder.succeed(&format!("train @set --out @run {TRAIN}"));
        folder
    })
}

/// A copy of the fixture's dataset in `set`, to damage.
fn copied_set() -> Folder {
    let folder = Folder::empty();
    copy(&fixture().path("set"), &folder.path("set"));
    folder
}

fn keys(value: &Value) -> Vec<&str> {
    value.as_object().unwrap().keys().map(String::as_str).collect()
}

#[test]
fn a_run_directory_has_its_files_and_metrics_have_their_keys() {
    let run = fixture().path("run");
    for name in ["config.toml", "metrics.json", "model.ply", "train.csv"] {
        assert!(run.join(name).is_file(), "{name}");
    }
    assert!(file_names(&run).iter().all(|name| !name.ends_with(".partial")));
    let metrics = fixture().json("run/metrics.json");
    let residual = &metrics["residual_transmittance"];
    let known =
        "mean views seconds gaussians steps residual_transmittance spent ended trained_with";
    assert_eq!(keys(&metrics).join(" "), known);
    for made_by in [&metrics["trained_with"], &fixture().json("run/done.json")["trained_with"]] {
        assert_eq!(made_by["nightsplat"], env!("CARGO_PKG_VERSION"));
        assert!(!made_by["device"].as_str().unwrap().is_empty(), "{made_by}");
    }
    let scores = ["psnr", "psnr_channel_mean", "ssim"];
    for (value, known) in [
        (residual, &["mean", "views"][..]),
        (&residual["views"]["008"], &["mean", "q99"]),
        (&metrics["mean"], &scores),
        (&metrics["views"], &["000", "008"]),
        (&metrics["views"]["008"], &scores),
    ] {
        assert_eq!(keys(value), known);
    }
    assert_eq!(metrics["steps"], 40);
    assert!(metrics["gaussians"].as_u64() > Some(1000) && metrics["seconds"].as_f64() > Some(0.0));
    let views = metrics["views"].as_object().unwrap();
    let mean = views.values().map(|view| view["psnr"].as_f64().unwrap()).sum::<f64>() / 2.0;
    assert!((metrics["mean"]["psnr"].as_f64().unwrap() - mean).abs() < 1e-9);

    let log = fixture().text("run/train.csv");
    assert_eq!(log.lines().next(), Some("step,view,loss,l1,ssim,gaussians,milliseconds"));
    assert_eq!(log.lines().count(), 41);
    assert!(log.lines().nth(40).unwrap().starts_with("40,"));
    let config = fixture().text("run/config.toml");
    assert!(config.starts_with("# trained with {\"nightsplat\":"), "{config}");
    says(&config, &["seed = 3", "curve = \"ap3\""]);
    assert!(fixture().model("run").starts_with(b"ply\nformat binary_little_endian"));
}

#[test]
fn a_seed_gives_one_model_for_any_references() {
    let folder = copied_set();
    // Every reference pixel changes, but the model's bits must not.
    for name in file_names(folder.path("set/high")) {
        let path = folder.path("set/high").join(name);
        let mut image = Image::load(&path).unwrap();
        image.data.iter_mut().for_each(|value| *value = 1.0 - *value);
        image.save_png8(&path).unwrap();
    }
    folder.succeed(&format!("train @set --out @run {TRAIN}"));
    let first = fixture().model("run");
    assert!(first == folder.model("run"), "the references changed the model");
    let means = [fixture(), &folder].map(|folder| folder.json("run/metrics.json")["mean"].clone());
    assert_ne!(means[0], means[1], "the scores ought to change with the references");
    // A finished run is the configuration of the next, which replaces it.
    let config = fixture().path("run/config.toml");
    folder.succeed(&format!("train @set --out @run --config {} --overwrite", config.display()));
    assert!(first == folder.model("run"), "the configuration changed the model");
    let other = TRAIN.replace("--seed 3", "--seed 4");
    folder.succeed(&format!("train @set --out @run {other} --overwrite"));
    assert!(first != folder.model("run"), "another seed ought to change the model");
}

#[test]
fn eval_agrees_with_train_and_saves_the_scored_images() {
    let fixture = fixture();
    let run = fixture.path("run");
    let printed = json(fixture.succeed("eval @run --json --save-images"));
    let trained = fixture.json("run/metrics.json");
    assert_eq!(printed, trained);
    let names = ["000.png", "008.png"];
    assert_eq!(file_names(run.join("eval/renders")), names);
    assert_eq!(file_names(run.join("eval/references")), names);
    for name in ["000", "008"] {
        let load = |kind| Image::load(run.join(format!("eval/{kind}/{name}.png"))).unwrap();
        let scores = Scores::measure(&load("renders"), &load("references")).unwrap();
        let scored = &trained["views"][name];
        assert!((scores.psnr - scored["psnr"].as_f64().unwrap()).abs() < 0.01, "{name}");
        assert!((scores.ssim - scored["ssim"].as_f64().unwrap()).abs() < 0.001, "{name}");
    }
    says(&fixture.succeed("eval @run --report @eval.html"), &["wrote ", "eval.html"]);
    let parts = ["The worst view, 0", "error, times 5", "reference image<", ">loss<", "mean</td>"];
    says(&fixture.text("eval.html"), &parts);
    let table = fixture.succeed("eval @run");
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
    let scores = json(fixture.succeed("eval @run --uniform-ssim --json --save-images"));
    for name in ["000", "008"] {
        let load =
            |kind| Image::load(fixture.path(&format!("run/eval/{kind}/{name}.png"))).unwrap();
        let expected = metrics::ssim_uniform(&load("renders"), &load("references")).unwrap();
        let scored = scores["views"][name]["ssim_uniform"].as_f64().unwrap();
        assert!((scored - expected).abs() < 1e-4, "{name}: {scored}, not {expected}");
    }
    let table = fixture.succeed("eval @run --uniform-ssim");
    says(table.lines().next().unwrap(), &["SSIM, uniform"]);
}

#[test]
fn eval_scores_lpips_with_given_weights() {
    let fixture = fixture();
    let weights = fixture.path("weights.safetensors");
    let eval = "eval @run --lpips @weights.safetensors";
    for (network, range, key, title) in [
        (Network::Alex, "signed", "lpips", "LPIPS "),
        (Network::Alex, "unit", "lpips_alex_unit", "LPIPS alex unit"),
        (Network::Vgg, "signed", "lpips_vgg_signed", "LPIPS vgg signed"),
        (Network::Vgg, "unit", "lpips_vgg_unit", "LPIPS vgg unit"),
    ] {
        common::lpips::write(network, &weights, |_, _, _| {});
        let more = if range == "signed" { "" } else { "--lpips-range unit" };
        let scores = json(fixture.succeed(&format!("{eval} {more} --json")));
        let of = |name: &str| scores["views"][name][key].as_f64().unwrap();
        let mean = scores["mean"][key].as_f64().unwrap();
        assert!((mean - (of("000") + of("008")) / 2.0).abs() < 1e-12 && mean > 0.0, "{scores}");
        let message = serde_json::json!({ "network": network.name(), "range": range, "key": key });
        assert_eq!(scores["lpips"], message);
        let keys = keys(&scores["mean"]);
        assert_eq!(keys.iter().filter(|key| key.starts_with("lpips")).count(), 1, "{keys:?}");
        let table = fixture.succeed(&format!("{eval} {more}"));
        let header = format!("{} ", table.lines().next().unwrap());
        assert!(header.contains(title) && table.contains(&format!("{mean:.4}")), "{table}");
    }
    fs::write(&weights, "no weights").unwrap();
    fixture.refused(eval, 3, &["weights.safetensors", "safetensors"]);
    fixture.refused("eval @run --lpips-range unit", 2, &["--lpips <WEIGHTS>"]);
    assert!(fixture.json("run/metrics.json").get("lpips").is_none(), "train scores no LPIPS");
}

#[test]
fn a_set_without_references_and_photographs_of_test_views_scores_nothing() {
    let folder = copied_set();
    fs::remove_dir_all(folder.path("set/high")).unwrap();
    for name in ["000", "008"] {
        fs::remove_file(folder.path(&format!("set/low/{name}.png"))).unwrap();
    }
    folder.succeed("train @set --out @run --steps 2");
    assert_eq!(folder.json("run/metrics.json")["mean"], Value::Null);
    let (printed, message) = folder.run("eval @run --json", 0);
    let printed = json(printed);
    assert_eq!((&printed["mean"], keys(&printed["views"]).len()), (&Value::Null, 0));
    says(&message, &["no test view has a reference image or a photograph"]);
    assert_eq!(folder.succeed("eval @run").lines().count(), 2);
}

#[test]
fn every_pose_of_a_split_is_rendered_with_or_without_an_image() {
    let folder = copied_set();
    // A test view that has only its pose.
    for name in ["low", "high"] {
        fs::remove_file(folder.path(&format!("set/{name}/008.png"))).unwrap();
    }
    fs::create_dir(folder.path("run")).unwrap();
    folder.write("run/model.ply", fixture().model("run"));
    let config = fixture().text("run/config.toml");
    folder
        .write("run/config.toml", config.replace(&fixture().named("@set"), &folder.named("@set")));
    let render = |split: &str, format: &str| {
        folder.succeed(&format!("render @run --split {split} --out @{split} --format {format}"));
        file_names(folder.path(split))
    };
    let all: Vec<_> = (0..9).map(|view| format!("{view:03}.exr")).collect();
    assert_eq!(render("all", "exr"), all);
    assert_eq!(render("test", "png"), ["000.png", "008.png"]);
    assert_eq!(render("train", "png").len(), 7);
    for name in ["000", "008"] {
        let [float, byte] = [format!("all/{name}.exr"), format!("test/{name}.png")]
            .map(|path| Image::load(folder.path(&path)).unwrap());
        assert_eq!((byte.width, byte.height), (64, 48));
        for (float, byte) in float.data.iter().zip(&byte.data) {
            assert!((float.clamp(0.0, 1.0) - byte).abs() < 0.51 / 255.0, "{float} {byte}");
        }
    }
}

#[test]
fn renders_never_replace_the_photographs() {
    let before = fixture().read("set/low/001.png");
    let parts = ["low", "inside the dataset", "--out"];
    fixture().refused("render @run --split all --out @set/low", 1, &parts);
    assert_eq!(before, fixture().read("set/low/001.png"));
}

#[test]
fn doctor_lists_the_devices_and_their_features() {
    let parts = ["yes  timelineSemaphore", "Vulkan 1.", "ready: trains on ", "colmap  "];
    says(&succeed("doctor"), &parts);
}

#[test]
fn bench_checks_and_times_every_kernel_of_a_step_and_lists_the_others() {
    let small = "bench --json --repeats 1 --width 64 --height 48 --gaussians 300";
    let printed = json(succeed(small));
    for of in ["device", "driver"] {
        assert!(!printed[of].as_str().unwrap().is_empty(), "{of}");
    }
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
        conv3x3_half conv3x3_weight_gradient_half conv_strided depth_limits expose expose_backward \
        exposure_center exposure_gradient first_not_finite lamp_backward lamp_gradient largest_magnitude \
        mask_gradient mask_render max_pool motion_vectors norm_backward_half norm_backward_sums_half \
        norm_forward_half norm_statistics_half normals normals_backward pack_map pack_pixels pack_weights \
        parameter_terms photograph_light pick_splats place_pairs self_test smoothing_floor sort_tiles \
        tile_begins unpack_map";
    assert_eq!(everywhere.collect::<Vec<_>>().join(" "), elsewhere);
    let mut named = [keys(&printed["errors"]), not_covered].concat();
    named.sort_unstable();
    assert_eq!(named, kernels::NAMES);
}

#[test]
fn bench_times_a_trained_model_in_the_storage_of_training() {
    let bench = |arguments: &str| {
        let options = "--json --unchecked --repeats 1 --steady 2";
        json(fixture().succeed(&format!("bench {options} {arguments}")))
    };
    let of_run = bench("@run --precision 16");
    let kernels = keys(&of_run["kernels"]);
    assert!(kernels.contains(&"adam_gaussian"), "{kernels:?}");
    assert_eq!(of_run["scene"], fixture().named("@run"));
    assert_eq!(of_run["precision"]["rest"], "16");
    let of_file = bench("@run/model.ply --width 32 --height 40");
    assert_eq!((&of_file["width"], &of_file["height"]), (&32.into(), &40.into()));
    let counts = [&of_run["gaussians"], &of_file["gaussians"]].map(|count| count.as_u64().unwrap());
    assert!(counts[0] > 0 && counts[0] == counts[1], "{counts:?}");
    for seen in [&of_run, &of_file] {
        assert!(seen["intersections"].as_u64().unwrap() > counts[0] / 2, "{seen}");
    }
}

#[test]
fn demo_changes_no_foreign_folder() {
    let folder = Folder::empty();
    folder.write("thesis.tex", "mine");
    folder.refused("demo --out @", 1, &["not empty", "--out"]);
    assert_eq!(file_names(&folder), ["thesis.tex"]);
}

#[test]
fn demo_is_a_sweep_of_four_curves_that_continues_and_links_the_model() {
    let folder = Folder::empty();
    let table = folder.succeed("demo --out @ --steps 20");
    for curve in ["auto", "linear", "ase", "ap3"] {
        assert!(folder.path(&format!("curve={curve}/model.ply")).is_file(), "{table}");
    }
    let page = folder.text("index.html");
    says(&page, &["exposed", "<a href=\"curve=auto/model.html\">"]);
    // First the flight, then pictures, then scores.
    let order = ["<iframe", "data:image/png", "<table"].map(|part| page.find(part).unwrap());
    assert!(order.is_sorted(), "{order:?}");
    assert!(folder.path("curve=auto/model.html").is_file());
    assert_eq!(folder.succeed("demo --out @ --steps 20"), table, "nothing is trained twice");
}

/// A reader that ends early, as `head` does.
#[test]
fn a_closed_pipe_ends_a_command_quietly() {
    for arguments in ["tone apply @set --json", "diagnose @set", "doctor", "tone list"] {
        let mut command = fixture().command(arguments);
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = command.stdout(writer).stderr(Stdio::piped()).output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && !message.contains("error"), "{arguments}: {message}");
    }
}

#[test]
fn man_pages_keep_the_lines_of_their_examples() {
    let folder = Folder::empty();
    folder.succeed("man @");
    let page = folder.text("nightsplat-train.1");
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
    assert!(names.len() <= 15, "{names:?}");
    assert!(names.contains(&"train") && !names.contains(&"synth"), "{names:?}");
    let (short, all) = (succeed("train -h"), succeed("train --help-all"));
    assert_eq!(short, succeed("train --help"));
    says(&short, &["--preset", "--max-vram", "Example:", "--help-all"]);
    assert!(!short.contains("--ssim-weight"), "{short}");
    for group in ["Photographs:", "Tone curve:", "Model:", "Logs and checks:"] {
        assert!(all.contains(&format!("\n{group}\n")), "no `{group}` in {all}");
    }
    let options = "--curve --gain --theta --steps --downscale --seed --sh-degree --ssim-weight --max-gaussians \
         --background --reference --device --config --eval-every --out --overwrite --max-resolution --cache \
         --test-every --tensorboard";
    says(&all, &options.split_whitespace().collect::<Vec<_>>());
}
