//! Errors of the binary for bad input.

use crate::common::command::{Folder, refused_with, says};
use crate::common::fixture as committed;
use crate::common::prelude::*;
use crate::{copied_set, fixture};

/// Trainings, `TRAIN`, and other commands that must be refused with one line, and leave no run that looks complete.
fn refuses_all(folder: &Folder, table: &str) {
    folder.refuses_all(&table.replace("TRAIN", "train @set --out @refused"));
    for name in ["refused/metrics.json", "refused/model.ply"] {
        assert!(!folder.join(name).exists(), "{name} remains");
    }
}

/// A step of training on the set must succeed and print all of `parts` on standard error.
fn trains_and_says(folder: &Folder, options: &str, parts: &[&str]) {
    let (_, stderr) = folder.run(&format!("train @set --out @run --steps 1 {options}"), 0);
    assert!(folder.join("run/metrics.json").exists(), "{stderr}");
    says(&stderr, parts);
}

fn edit_listing(folder: &Folder, change: impl FnOnce(&mut Value)) {
    let mut listing = folder.json("set/transforms_train.json");
    change(&mut listing);
    folder.write("set/transforms_train.json", listing.to_string());
}

#[test]
fn a_missing_dataset_and_one_without_photographs_are_named() {
    let folder = copied_set();
    fs::remove_dir_all(folder.join("set/low")).unwrap();
    fs::create_dir(folder.join("empty")).unwrap();
    let table = "
        3 | train @nowhere --out @refused | nowhere & not a folder
        3 | train @empty --out @refused   | holds no dataset & transforms";
    refuses_all(&folder, table);
    assert!(!folder.join("refused").exists());
    refuses_all(&folder, "3 | TRAIN | no photograph is left to train on");
}

#[test]
fn absent_and_broken_photographs_are_left_out_by_name() {
    let folder = copied_set();
    fs::remove_file(folder.join("set/low/003.png")).unwrap();
    folder.write("set/low/004.png", "no image");
    trains_and_says(&folder, "", &["low/003.png", "absent", "low/004.png", "not a readable"]);
}

#[test]
fn points_that_no_device_represents_and_views_that_show_nothing_are_reported() {
    let folder = copied_set();
    let points = "set/colmap_sparse/0/points3D.txt";
    let more = "900001 1e39 0 0 1 2 3 0.5\n900002 0 -1e300 0 1 2 3 0.5\n900003 1e9 0 0 1 2 3 0.5\n";
    folder.write(points, folder.text(points) + more);
    trains_and_says(&folder, "--plan none", &["3 of ", "points", "left out"]);

    let folder = copied_set();
    edit_listing(&folder, |listing| {
        // The second view looks the opposite way: the x and z axes are negated.
        let matrix = listing["frames"][1]["transform_matrix"].as_array_mut().unwrap();
        for (row, column) in (0..3).flat_map(|row| [(row, 0), (row, 2)]) {
            matrix[row][column] = Value::from(-matrix[row][column].as_f64().unwrap());
        }
    });
    trains_and_says(&folder, "--plan none", &["view 002 contains none"]);

    let folder = copied_set();
    edit_listing(&folder, |listing| {
        listing["frames"][2]["transform_matrix"][0][3] = Value::from(1e300);
    });
    trains_and_says(&folder, "--plan none", &["view 003 stands", "check its pose"]);
}

#[test]
fn images_far_larger_than_their_views_are_refused_before_they_are_decoded_or_left_out() {
    let bomb = |path: &str| {
        let folder = copied_set();
        let path = folder.join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        Image::from_fn(1200, 900, |x, y| [(x + y) as f32 / 2100.0; 3]).save_png8(path).unwrap();
        folder
    };
    let table = "3 | TRAIN | high/000.png & 1200x900 & 64 times";
    refuses_all(&bomb("set/high/000.png"), table);
    let parts = ["depth of view 001 is not used", "64 times"];
    trains_and_says(&bomb("set/depth/001.png"), "--plan none --parts depth", &parts);
}

#[test]
fn a_run_directory_is_not_replaced_without_a_request_nor_created_in_a_file() {
    let before = fixture().read("run/metrics.json");
    let table = "
        1 | train @set --out @run                | already contains a run & --overwrite
        1 | train @set --out @set/low/000.png/run | cannot be written";
    fixture().refuses_all(table);
    assert_eq!(before, fixture().read("run/metrics.json"));
}

#[test]
fn misuse_is_one_line_with_exit_code_2() {
    let table = "
        2 | TRAIN --curve sepia | sepia & linear, ase, ap3 & --help
        2 | TRAIN --steps 0 | --steps
        2 | TRAIN --sh-degree 4 | --sh-degree & 0 to 3
        2 | TRAIN --downscale 0.5 | downscale
        2 | TRAIN --background blue | background (--background) is \"blue\" & black or random
        2 | TRAIN --stepz 3 | --stepz
        2 | TRAIN --steps many | steps (--steps) is \"many\"; it must be a whole number, at least 1
        2 | TRAIN --set stop.not_finite=skip | stop.not_finite is & stop or skip-view
        2 | TRAIN --set schedule.initial_rates.quats=nan | schedule.initial_rates.quats is nan
        2 | TRAIN --max-vram 4 | --max-vram & 4G or 1.5G
        2 | TRAIN --set max_ram=100 | max_ram & with its unit
        2 | TRAIN --set density.gradient=1 | `density.gradient` & `density.gradient_threshold`
        2 | TRAIN --exposure on --parts tonemapper | exposure.learn (--exposure) is true & tonemapper
        2 | TRAIN --steps 5 --iterations 7 | --steps & multiple times
        2 | train | --out & required
        2 | evaluate x | evaluate
        2 | render x --split none --out y | none & train, test, all
        2 | export @run | --format
        2 | export @run --out model | pass --format: ply, spz, glb
        2 | export @run --out model.xyz | model.xyz has the ending of no format
        2 | export @run --format spz --out a.ply | a.ply is a file of --format ply
        2 | bench --repeats 0 | --repeats
        2 | bench --precision 8 | precision.rest & 32 or 16
        2 | bench model.ply --gaussians 7 | --gaussians
        3 | bench no.ply | no.ply
        2 | train photos --out run --steps -3 | --steps & -3
        2 | train photos --out run --progress loud | bar & plain & json & none";
    refuses_all(fixture(), table);
}

#[test]
fn a_row_of_a_table_fails_for_another_code_for_words_that_are_not_said_and_for_what_succeeds() {
    for row in
        ["3 | evaluate x | evaluate", "2 | evaluate x | absent", "0 | tone list | ", "2 | evaluate"]
    {
        let tried = std::panic::catch_unwind(|| fixture().refuses_all(row));
        assert!(tried.is_err(), "{row}");
    }
}

#[test]
fn options_of_other_trainers_get_a_hint() {
    fixture().refuses_all(
        "
        2 | train -s photos --out run | there is no `- & use DATASET
        2 | train --source_path photos --out run | there is no `- & use DATASET
        2 | train --data photos --out run | there is no `- & use DATASET
        2 | train photos -m run | there is no `- & use --out DIR
        2 | train photos --model_path run | there is no `- & use --out DIR
        2 | train photos --out run --resolution 4 | there is no `- & use --downscale F
        2 | train photos --out run --max-num-iterations 7000 | there is no `- & use --steps N
        2 | train photos --out run --format ply | there is no `- & nightsplat export RUN --format
        2 | train photos --out run --cap-max 1000 | there is no `- & use --max-gaussians N",
    );
}

#[test]
fn an_output_that_cannot_be_written_is_refused_before_anything_is_read() {
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
        let command = command.replace("OUT", "@set/low/000.png");
        fixture().refused(&command, 1, &["000.png/", "cannot be written"]);
    }
}

/// The exit code and standard error of `nightsplat` with arguments, in a shell after these words.
#[cfg(unix)]
fn after(shell: &str, folder: &Folder, arguments: &str) -> (Option<i32>, String) {
    let nightsplat = folder.command(arguments);
    let mut sh = Command::new("sh");
    sh.args(["-c", &format!("{shell}; exec \"$0\" \"$@\"")]).arg(nightsplat.get_program());
    sh.args(nightsplat.get_args());
    sh.envs(nightsplat.get_envs().filter_map(|(name, value)| Some((name, value?))));
    let output = sh.output().unwrap();
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[cfg(unix)]
#[test]
fn a_limit_of_the_size_of_files_is_an_error_that_names_the_file_and_a_full_disk_ends_help() {
    let folder = Folder::empty();
    let edit = format!("edit {} --up 0,-1,0 --out @edited.ply", fixture().named("@run/model.ply"));
    let (code, stderr) = after("ulimit -f 4", &folder, &edit);
    assert_eq!(code, Some(1), "{stderr}");
    says(&stderr, &["edited.ply: cannot be written (File too large"]);
    assert_eq!(fs::read_dir(&folder).unwrap().count(), 0, "a partial file");
    if Path::new("/dev/full").exists() {
        let (code, stderr) = after("exec > /dev/full", &folder, "train --help");
        assert_eq!(code, Some(1), "{stderr}");
        assert!(stderr.starts_with("error: help cannot be written"), "{stderr}");
    }
}

#[cfg(unix)]
#[test]
fn an_address_space_without_room_for_a_driver_is_named_however_small_it_is() {
    for mebibytes in [150, 400] {
        let limit = format!("ulimit -v {}", mebibytes << 10);
        let (code, stderr) = after(&limit, fixture(), "doctor");
        assert_eq!(code, Some(4), "{stderr}");
        assert!(stderr.contains("raise `ulimit -v`"), "{mebibytes}: {stderr}");
    }
}

#[test]
fn a_model_that_is_refused_names_its_remedy() {
    let folder = Folder::empty();
    let whole = fixture().model("run");
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
        folder.write(name, bytes);
        let export = format!("export @{name} --format spz --out @out.spz");
        folder.refused(&export, 3, &[&[name][..], &parts].concat());
    }
    // More than there is memory.
    folder.write("long.ply", "no model");
    fs::File::options()
        .write(true)
        .open(folder.join("long.ply"))
        .unwrap()
        .set_len(1 << 43)
        .unwrap();
    let parts = ["long.ply", "neither PLY, SPZ nor SOG"];
    folder.refused("edit @long.ply --up 0,-1,0 --out x.ply", 3, &parts);
    folder.write("scan.zip", "PK");
    let set = fixture().named("@set");
    let train = format!("train {set} --out @run --steps 1 --plan none --init @scan.zip/model.ply");
    says(&folder.run(&train, 3).1, &["model.ply: is within", "extract it"]);
}

#[test]
fn the_number_of_steps_has_short_forms_and_the_alias_iterations() {
    for (option, steps) in [("--steps 1e4", 10_000), ("--steps 5k", 5000), ("--iterations 7", 7)] {
        let (message, _) = fixture().run(&format!("train @set --out @no --explain {option}"), 0);
        assert!(message.contains(&format!("steps = {steps}  (--steps)")), "{option}: {message}");
    }
}

#[test]
fn a_configuration_with_an_unknown_key_or_a_value_of_nan_names_it_and_its_file() {
    let folder = copied_set();
    folder.write("stepz/config.toml", "steps = 3\nstepz = 4\n");
    folder.write("nan/config.toml", "[schedule.initial_rates]\nquats = nan\n");
    let table = "
        3 | TRAIN --config @stepz/config.toml | config.toml & stepz & (line 2)
        3 | TRAIN --config @nan/config.toml | config.toml & schedule.initial_rates.quats is nan";
    refuses_all(&folder, table);
}

#[test]
fn every_setting_is_explained_with_its_origin_and_nothing_is_trained() {
    let folder = copied_set();
    folder.write("a.toml", "near = 0.2\nsteps = 3\n");
    let explained =
        |options: &str| folder.succeed(&format!("train @set --out @run --explain {options}"));
    let lines = [
        "steps = 400  (preset draft)\n",
        "seed = 4  (--seed)\n",
        "stop.margin = 1.0  (--set)\n",
        "exposure.learn = false  (plan)\n",
        "ssim_weight = 0.2  (default)\n    Weight of the loss 1 - SSIM",
    ];
    says(&explained("--preset draft --seed 4 --set stop.margin=1"), &lines);
    let near = folder.named("near = 0.2  (@a.toml)\n");
    let lines = [&near[..], "steps = 5  (--steps)\n", "sh_degree = 0  (preset draft)"];
    says(&explained("--preset draft --config @a.toml --steps 5"), &lines);
    assert!(!folder.join("run").exists());
}

#[test]
fn an_unknown_device_and_no_device_are_refused_with_the_remedy() {
    let table = "
        4 | TRAIN --device voodoo | voodoo & there are:
        4 | TRAIN --device 99     | number 99 & there are:";
    refuses_all(fixture(), table);
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
    let apply = format!("tone apply {} --out @", committed("lom/low/000.png").display());
    let folder = Folder::empty();
    let output = folder.command(&apply).env("VK_LAYER_ENABLES", advice).output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(101), "{stderr}");
    says(&stderr, &["validation failed in\nmain: "]);
}

#[test]
fn eval_and_render_refuse_a_folder_without_a_finished_run() {
    let folder = Folder::empty();
    let none = "
        3 | eval @                         | no config.toml & nightsplat train
        3 | render @ --split all --out x | no config.toml & nightsplat train";
    folder.refuses_all(none);
    let config = fixture().text("run/config.toml");
    folder.write("config.toml", config.replace(&fixture().named("@set"), &folder.named("@moved")));
    folder.refused("eval @", 3, &["model.ply", "neither finished"]);
    let model = fixture().model("run");
    folder.write("model.ply", &model);
    folder.refused("eval @", 3, &["config.toml", "moved", "--dataset"]);
    folder.write("config.toml", config);
    folder.write("model.ply", &model[..model.len() / 2]);
    folder.refused("eval @", 3, &["model.ply"]);
}
