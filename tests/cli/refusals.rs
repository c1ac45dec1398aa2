//! Errors of the binary for bad input.

use std::fs;
use std::path::{Path, PathBuf};

use nightsplat_photographs::image::{Image, ImageFile};
use serde_json::Value;
use tempfile::TempDir;

use crate::common::command::{command, refused, refused_with, run};
use crate::{copied_set, fixture};

/// Training on `root` must fail with one line and leave no run that looks complete.
fn refuses_to_train(root: &Path, options: &str, code: i32, parts: &[&str]) {
    let run = root.join("run");
    refused(&format!("train {} --out {} {options}", root.display(), run.display()), code, parts);
    for name in ["metrics.json", "model.ply"] {
        assert!(!run.join(name).exists(), "{name} remains");
    }
}

/// A step of training on `root` must succeed and print all of `parts` on standard error.
fn trains_and_says(root: &Path, options: &str, parts: &[&str]) {
    let out = root.join("run");
    let train = format!("train {} --out {} --steps 1 {options}", root.display(), out.display());
    let (_, stderr) = run(&train, 0);
    assert!(out.join("metrics.json").exists(), "{stderr}");
    for part in parts {
        assert!(stderr.contains(part), "no `{part}` in: {stderr}");
    }
}

fn edit(path: PathBuf, change: impl FnOnce(String) -> String) {
    let text = fs::read_to_string(&path).unwrap();
    fs::write(path, change(text)).unwrap();
}

fn edit_listing(set: &TempDir, change: impl FnOnce(&mut Value)) {
    edit(set.path().join("transforms_train.json"), |text| {
        let mut listing = serde_json::from_str(&text).unwrap();
        change(&mut listing);
        listing.to_string()
    });
}

#[test]
fn a_missing_dataset_and_one_without_photographs_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let nowhere = folder.path().join("nowhere");
    let run = folder.path().join("run");
    refused(
        &format!("train {} --out {}", nowhere.display(), run.display()),
        3,
        &["nowhere", "not a folder"],
    );
    assert!(!run.exists());
    refuses_to_train(folder.path(), "", 3, &["holds no dataset", "transforms"]);
    let set = copied_set();
    fs::remove_dir_all(set.path().join("low")).unwrap();
    refuses_to_train(set.path(), "", 3, &["no photograph is left to train on"]);
}

#[test]
fn absent_and_broken_photographs_are_left_out_by_name() {
    let set = copied_set();
    fs::remove_file(set.path().join("low/003.png")).unwrap();
    fs::write(set.path().join("low/004.png"), "no image").unwrap();
    trains_and_says(set.path(), "", &["low/003.png", "absent", "low/004.png", "not a readable"]);
}

#[test]
fn points_that_no_device_represents_and_views_that_show_nothing_are_reported() {
    let set = copied_set();
    edit(set.path().join("colmap_sparse/0/points3D.txt"), |text| {
        text + "900001 1e39 0 0 1 2 3 0.5\n900002 0 -1e300 0 1 2 3 0.5\n900003 1e9 0 0 1 2 3 0.5\n"
    });
    trains_and_says(set.path(), "--plan none", &["3 of ", "points", "left out"]);

    let set = copied_set();
    edit_listing(&set, |listing| {
        // The second view looks the opposite way: the x and z axes are negated.
        let matrix = listing["frames"][1]["transform_matrix"].as_array_mut().unwrap();
        for (row, column) in (0..3).flat_map(|row| [(row, 0), (row, 2)]) {
            matrix[row][column] = Value::from(-matrix[row][column].as_f64().unwrap());
        }
    });
    trains_and_says(set.path(), "--plan none", &["view 002 contains none"]);

    let set = copied_set();
    edit_listing(&set, |listing| {
        listing["frames"][2]["transform_matrix"][0][3] = Value::from(1e300);
    });
    trains_and_says(set.path(), "--plan none", &["view 003 stands", "check its pose"]);
}

#[test]
fn images_far_larger_than_their_views_are_refused_before_they_are_decoded_or_left_out() {
    let bomb = |set: &TempDir, path: &str| {
        let path = set.path().join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        Image::from_fn(1200, 900, |x, y| [(x + y) as f32 / 2100.0; 3]).save_png8(path).unwrap();
    };
    let set = copied_set();
    bomb(&set, "high/000.png");
    refuses_to_train(set.path(), "", 3, &["high/000.png", "1200x900", "64 times"]);
    let set = copied_set();
    bomb(&set, "depth/001.png");
    let parts = ["depth of view 001 is not used", "64 times"];
    trains_and_says(set.path(), "--plan none --parts depth", &parts);
}

#[test]
fn a_run_directory_is_not_replaced_without_a_request_nor_created_in_a_file() {
    let fixture = fixture();
    let before = fs::read(fixture.path("run/metrics.json")).unwrap();
    refused(
        &format!("train {} --out {}", fixture.set(), fixture.run()),
        1,
        &["already contains a run", "--overwrite"],
    );
    assert_eq!(before, fs::read(fixture.path("run/metrics.json")).unwrap());
    let file = fixture.path("set/low/000.png");
    refused(
        &format!("train {} --out {}/run", fixture.set(), file.display()),
        1,
        &["cannot be written"],
    );
}

#[test]
fn misuse_is_one_line_with_exit_code_2() {
    let set = fixture().set();
    let train =
        |options: &str, parts: &[&str]| refuses_to_train(Path::new(&set), options, 2, parts);
    train("--curve sepia", &["sepia", "linear, ase, ap3", "--help"]);
    train("--steps 0", &["--steps"]);
    train("--sh-degree 4", &["--sh-degree", "0 to 3"]);
    train("--downscale 0.5", &["downscale"]);
    train("--background blue", &["background (--background) is \"blue\"", "black or random"]);
    train("--stepz 3", &["--stepz"]);
    train("--steps many", &["steps (--steps) is \"many\"; it must be a whole number, at least 1"]);
    train("--set stop.not_finite=skip", &["stop.not_finite is", "stop or skip-view"]);
    train("--set schedule.initial_rates.quats=nan", &["schedule.initial_rates.quats is nan"]);
    train("--max-vram 4", &["--max-vram", "4G or 1.5G"]);
    train("--set max_ram=100", &["max_ram", "with its unit"]);
    train("--set density.gradient=1", &["`density.gradient`", "`density.gradient_threshold`"]);
    train(
        "--exposure on --parts tonemapper",
        &["exposure.learn (--exposure) is true", "tonemapper"],
    );
    refused("train", 2, &["--out", "required"]);
    refused("evaluate x", 2, &["evaluate"]);
    refused("render x --split none --out y", 2, &["none", "train, test, all"]);
    refused("bench --repeats 0", 2, &["--repeats"]);
    refused("bench --precision 8", 2, &["precision.rest", "32 or 16"]);
    refused("bench model.ply --gaussians 7", 2, &["--gaussians"]);
    refused("bench no.ply", 3, &["no.ply"]);
    refused("train photos --out run --steps -3", 2, &["--steps", "-3"]);
}

#[test]
fn options_of_other_trainers_get_a_hint() {
    for (options, ours) in [
        ("-s photos --out run", "use DATASET"),
        ("--source_path photos --out run", "use DATASET"),
        ("--data photos --out run", "use DATASET"),
        ("photos -m run", "use --out DIR"),
        ("photos --model_path run", "use --out DIR"),
        ("photos --out run --resolution 4", "use --downscale F"),
        ("photos --out run --max-num-iterations 7000", "use --steps N"),
        ("photos --out run --format ply", "nightsplat export RUN --format"),
        ("photos --out run --cap-max 1000", "use --max-gaussians N"),
    ] {
        refused(&format!("train {options}"), 2, &["there is no `-", ours]);
    }
}

#[test]
fn an_output_that_cannot_be_written_is_refused_before_anything_is_read() {
    let file = fixture().path("set/low/000.png").display().to_string();
    for command in [
        "train /nonexistent/set --out OUT/run",
        "sweep /nonexistent/set --curves all --out OUT/sweep",
        "pose /nonexistent/photos --out OUT/set",
        "render /nonexistent/run --split all --out OUT/pictures",
        "export /nonexistent/run --format glb --out OUT/a.glb",
        "diagnose /nonexistent/set --report OUT/a.html",
        "eval /nonexistent/run --report OUT/a.html",
        "tone apply /nonexistent/set --out OUT/toned",
    ] {
        refused(&command.replace("OUT", &file), 1, &["000.png/", "cannot be written"]);
    }
}

#[test]
fn an_export_has_the_format_of_its_ending_or_says_that_there_is_none() {
    let formats = "has the ending of no format; pass --format: ply, spz, glb";
    refused("export run --out model.xyz", 2, &["model.xyz", formats]);
    refused("export run --out model", 2, &[formats]);
    refused("export run --format spz --out a.ply", 2, &["a.ply is a file of --format ply"]);
    refused("export run", 2, &["--format"]);
}

/// `nightsplat` with arguments, in a shell after these words.
#[cfg(unix)]
fn after(shell: &str, arguments: &str) -> std::process::Output {
    let nightsplat = command(arguments);
    let mut sh = std::process::Command::new("sh");
    sh.args(["-c", &format!("{shell}; exec \"$0\" \"$@\"")]).arg(nightsplat.get_program());
    sh.args(nightsplat.get_args());
    sh.envs(nightsplat.get_envs().filter_map(|(name, value)| Some((name, value?))));
    sh.output().unwrap()
}

#[cfg(unix)]
#[test]
fn a_limit_of_the_size_of_files_is_an_error_that_names_the_file_and_a_full_disk_ends_help() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("edited.ply");
    let edit = format!("edit {}/model.ply --up 0,-1,0 --out {}", fixture().run(), out.display());
    let output = after("ulimit -f 4", &edit);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("edited.ply: cannot be written (File too large"), "{stderr}");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0, "a partial file");
    if Path::new("/dev/full").exists() {
        let output = after("exec > /dev/full", "train --help");
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        assert!(stderr.starts_with("error: help cannot be written"), "{stderr}");
    }
}

#[cfg(unix)]
#[test]
fn an_address_space_without_room_for_a_driver_is_named_however_small_it_is() {
    for mebibytes in [150, 400] {
        let output = after(&format!("ulimit -v {}", mebibytes << 10), "doctor");
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(4), "{stderr}");
        assert!(stderr.contains("raise `ulimit -v`"), "{mebibytes}: {stderr}");
    }
}

#[test]
fn a_model_that_is_refused_names_its_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let whole = fs::read(fixture().path("run/model.ply")).unwrap();
    let header = whole.windows(10).position(|bytes| bytes == b"end_header").unwrap() + 11;
    let text = String::from_utf8(whole[..header].to_vec()).unwrap();
    let changed = |from: &str, to: &str| {
        assert!(text.contains(from));
        [text.replacen(from, to, 1).as_bytes(), &whole[header..]].concat()
    };
    let again = "export the model again";
    for (name, bytes, parts) in [
        ("cut.ply", whole[..whole.len() - 3].to_vec(), ["is truncated", again]),
        ("list.ply", changed("float x", "list uchar float x"), ["list property", again]),
        ("int.ply", changed("float x", "int x"), ["of type int, not float", again]),
        ("near.ply", changed("near ", "near -"), ["states near", again]),
        ("a.spz", vec![0x1F, 0x8B, 0], ["cannot be unpacked", again]),
        ("a.sog", b"PK\x03\x04".to_vec(), ["is not a SOG", again]),
        ("empty.ply", vec![], ["neither PLY, SPZ nor SOG", "a run directory"]),
    ] {
        fs::write(path(name), bytes).unwrap();
        let [model, out] = [name, "out.spz"].map(|name| path(name).display().to_string());
        refused(
            &format!("export {model} --format spz --out {out}"),
            3,
            &[&[name][..], &parts].concat(),
        );
    }
    // More than there is memory.
    fs::write(path("long.ply"), "no model").unwrap();
    fs::File::options().write(true).open(path("long.ply")).unwrap().set_len(1 << 43).unwrap();
    let long = format!("edit {} --up 0,-1,0 --out x.ply", path("long.ply").display());
    refused(&long, 3, &["long.ply", "neither PLY, SPZ nor SOG"]);
    fs::write(path("scan.zip"), "PK").unwrap();
    let [zip, out] = ["scan.zip", "run"].map(|name| path(name).display().to_string());
    let train = format!("train {} --out {out} --steps 1 --plan none", fixture().set());
    let (_, stderr) = run(&format!("{train} --init {zip}/model.ply"), 3);
    assert!(stderr.contains("model.ply: is within") && stderr.contains("extract it"), "{stderr}");
}

#[test]
fn the_number_of_steps_has_short_forms_and_the_alias_iterations() {
    let folder = tempfile::tempdir().unwrap();
    let train = format!("train {} --out {}", fixture().set(), folder.path().join("run").display());
    for (option, steps) in [("--steps 1e4", 10_000), ("--steps 5k", 5000), ("--iterations 7", 7)] {
        let (message, _) = run(&format!("{train} --explain {option}"), 0);
        assert!(message.contains(&format!("steps = {steps}  (--steps)")), "{option}: {message}");
    }
    let twice = format!("{train} --steps 5 --iterations 7");
    refused(&twice, 2, &["--steps", "multiple times"]);
}

#[test]
fn a_configuration_with_an_unknown_key_or_a_value_of_nan_names_it_and_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("config.toml");
    let arguments = format!("--config {}", config.display());
    let set = fixture().set();
    for (text, parts) in [
        ("steps = 3\nstepz = 4\n", ["stepz", "(line 2)"]),
        ("[schedule.initial_rates]\nquats = nan\n", ["schedule.initial_rates.quats is nan", ""]),
    ] {
        fs::write(&config, text).unwrap();
        refuses_to_train(Path::new(&set), &arguments, 3, &[&["config.toml"][..], &parts].concat());
    }
}

#[test]
fn every_setting_is_explained_with_its_origin_and_nothing_is_trained() {
    let folder = tempfile::tempdir().unwrap();
    let (file, run) = (folder.path().join("a.toml"), folder.path().join("run"));
    fs::write(&file, "near = 0.2\nsteps = 3\n").unwrap();
    let explained = |options: &str| {
        let train = format!("train {} --out {} --explain", fixture().set(), run.display());
        crate::common::command::run(&format!("{train} {options}"), 0).0
    };
    let message = explained("--preset draft --seed 4 --set stop.margin=1");
    for line in [
        "steps = 400  (preset draft)\n",
        "seed = 4  (--seed)\n",
        "stop.margin = 1.0  (--set)\n",
        "exposure.learn = false  (plan)\n",
        "ssim_weight = 0.2  (default)\n    Weight of the loss 1 - SSIM",
    ] {
        assert!(message.contains(line), "no {line} in {message}");
    }
    let message = explained(&format!("--preset draft --config {} --steps 5", file.display()));
    assert!(message.contains(&format!("near = 0.2  ({})\n", file.display())), "{message}");
    assert!(
        message.contains("steps = 5  (--steps)\n")
            && message.contains("sh_degree = 0  (preset draft)"),
        "{message}"
    );
    assert!(!run.exists());
}

#[test]
fn an_unknown_device_and_no_device_are_refused_with_the_remedy() {
    let set = fixture().set();
    refuses_to_train(Path::new(&set), "--device voodoo", 4, &["voodoo", "there are: "]);
    refuses_to_train(Path::new(&set), "--device 99", 4, &["number 99", "there are: "]);
    let nothing =
        [("VK_DRIVER_FILES", "/nonexistent.json"), ("VK_ICD_FILENAMES", "/nonexistent.json")];
    for arguments in ["doctor", "bench", "demo --out /nonexistent/demo"] {
        refused_with(arguments, &nothing, 4, &["no Vulkan device", "install"]);
    }
}

#[test]
fn a_validation_message_fails_the_command() {
    if !cfg!(debug_assertions) {
        return crate::common::not_run(
            "debug-build",
            "commands are validated in debug builds alone",
        );
    }
    // Advice on best practices, which the code does not follow, is reported in every run.
    let advice = "VK_VALIDATION_FEATURE_ENABLE_BEST_PRACTICES_EXT";
    let photograph = crate::common::fixture("lom/low/000.png");
    let out = tempfile::tempdir().unwrap();
    let arguments = format!("tone apply {} --out {}", photograph.display(), out.path().display());
    let output = command(&arguments).env("VK_LAYER_ENABLES", advice).output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(101), "{stderr}");
    assert!(stderr.contains("validation failed in\nmain: "), "{stderr}");
}

#[test]
fn eval_and_render_refuse_a_folder_without_a_finished_run() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().display();
    for command in ["eval", "render --split all --out x"] {
        let (command, options) = command.split_once(' ').unwrap_or((command, ""));
        refused(&format!("{command} {run} {options}"), 3, &["no config.toml", "nightsplat train"]);
    }
    let config = fs::read_to_string(fixture().path("run/config.toml")).unwrap();
    let moved = folder.path().join("moved");
    fs::write(
        folder.path().join("config.toml"),
        config.replace(&fixture().set(), &moved.display().to_string()),
    )
    .unwrap();
    refused(&format!("eval {run}"), 3, &["model.ply", "neither finished"]);
    let model = fs::read(fixture().path("run/model.ply")).unwrap();
    fs::write(folder.path().join("model.ply"), &model).unwrap();
    refused(&format!("eval {run}"), 3, &["config.toml", "moved", "--dataset"]);
    fs::write(folder.path().join("config.toml"), config).unwrap();
    fs::write(folder.path().join("model.ply"), &model[..model.len() / 2]).unwrap();
    refused(&format!("eval {run}"), 3, &["model.ply"]);
}
