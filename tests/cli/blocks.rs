//! Scenes in blocks: plan, run, join, and what is refused.

use crate::common::command::{Folder, json};
use crate::common::contents;
use crate::common::prelude::*;

const PLAN: &str = "--blocks 2 --steps 120 --seed 3 --sh-degree 1 --max-gaussians 3000 --plan none";

/// A street, and in `city` its plan of two blocks, trained and joined, done once.
fn shared() -> &'static Folder {
    static CITY: OnceLock<Folder> = OnceLock::new();
    CITY.get_or_init(|| {
        let folder = Folder::empty();
        folder.succeed("synth @street --street 16 --width 48 --height 36");
        folder.succeed(&plan("city", PLAN));
        folder.succeed("blocks run @city");
        folder
    })
}

fn plan(out: &str, options: &str) -> String {
    format!("blocks plan @street --out @{out} {options}")
}

/// A copy of the plan with its runs, beside it.
fn copied() -> Folder {
    Folder::copy_of(&shared().join("city"))
}

#[test]
fn a_plan_has_the_same_bytes_on_any_number_of_threads_and_may_be_made_again() {
    let shared = shared();
    for (out, threads) in [("one", "1"), ("two", "2")] {
        let mut command = shared.command(&plan(out, PLAN));
        let output = command.env("RAYON_NUM_THREADS", threads).output().unwrap();
        assert!(output.status.success(), "{output:?}");
    }
    shared.succeed(&plan("two", PLAN));
    let [one, two] = ["one", "two"].map(|out| contents(&shared.path(out)));
    assert_eq!(one.len(), 5 * 3 + 5, "{:?}", one.iter().map(|(name, _)| name).collect::<Vec<_>>());
    assert!(one == two, "another plan");
}

#[test]
fn a_dry_run_writes_nothing() {
    let dry = plan("dry", &format!("{PLAN} --dry-run"));
    let text = shared().succeed(&dry);
    says(&text, &["2 blocks, each with", "120 steps of"]);
    let json = json(shared().succeed(&format!("{dry} --json")));
    assert_eq!(json["block"].as_array().unwrap().len(), 4);
    let steps = |row: &Value| row["steps"].as_u64().unwrap();
    let blocks: u64 = json["block"].as_array().unwrap().iter().map(steps).sum();
    assert_eq!((steps(&json["coarse"]), blocks), (15, 105));
    assert!(!shared().path("dry").exists());
}

#[test]
fn the_joined_tiles_are_those_of_the_cores_and_are_opened_like_a_run() {
    let shared = shared();
    let manifest = shared.json("city/model/manifest.json");
    let tiles = manifest["tiles"].as_array().unwrap();
    let counts: u64 = tiles.iter().map(|tile| tile["count"].as_u64().unwrap()).sum();
    assert_eq!((tiles.len(), Some(counts)), (2, manifest["count"].as_u64()));
    // Along the street, the first block ends where the second begins.
    let [first, second] = [&tiles[0], &tiles[1]].map(|tile| &tile["bounds"]);
    assert!(first["to"][0].as_f64() <= second["from"][0].as_f64());
    let scores = json(shared.succeed("eval @city --json"));
    assert_eq!(scores["gaussians"].as_u64(), Some(counts));
    assert!(scores["mean"]["psnr"].as_f64().unwrap() > 12.0, "{}", scores["mean"]);
    shared.succeed("export @city --out @city.ply");
    let exported = String::from_utf8_lossy(&shared.read("city.ply")).into_owned();
    assert!(exported.contains(&format!("element vertex {counts}\n")));
    // Tile by tile, in two levels of the same cells.
    let options = "--format streamed-sog --levels 2 --chunk 1000";
    shared.succeed(&format!("export @city {options} --out @streamed"));
    let index = shared.json("streamed/lod-meta.json");
    assert_eq!(index["lodLevels"].as_u64(), Some(2), "{index}");
}

#[test]
fn a_level_of_the_joined_model_is_those_of_its_tiles() {
    let level = |from: &str, name: &str| {
        let options = "--format ply --level 1 --chunk 1000";
        shared().succeed(&format!("export @{from} {options} --out @{name}"));
        let bytes = shared().read(name);
        let end = b"end_header\n";
        let header = bytes.windows(end.len()).position(|bytes| bytes == end).unwrap();
        bytes[header + end.len()..].to_vec()
    };
    let tiles = ["city/model/0/0000.ply", "city/model/0/0001.ply"];
    let tiles = tiles.map(|tile| level(tile, "level-of-tile.ply")).concat();
    assert!(level("city", "level.ply") == tiles, "cells across tiles");
}

#[test]
fn a_view_has_the_same_gain_in_every_block_and_in_a_run_on_all_views() {
    let shared = shared();
    let gains = |run: &str| shared.json(&format!("{run}/metrics.json"))["target_exposure"].clone();
    shared.succeed("train @street --out @whole --steps 1 --plan none");
    let whole = gains("whole");
    let mut count = 0;
    for block in ["coarse", "blocks/0000", "blocks/0001-2"] {
        let of_block = gains(&format!("city/{block}/run"));
        assert_eq!(of_block["model_gain"], whole["model_gain"], "{block}");
        for (view, gain) in of_block["gains"].as_object().unwrap() {
            assert_eq!(*gain, whole["gains"][view], "{block} {view}");
            count += 1;
        }
    }
    assert!(count > 80, "{count}");
}

#[test]
fn what_is_done_is_not_done_again_and_what_was_killed_gives_the_same_model() {
    let copy = copied();
    let before = copy.json("model/manifest.json");
    // As if the second training had been killed before its first checkpoint, and the join had not begun.
    for gone in ["blocks/0001-2/run", "model"] {
        fs::remove_dir_all(copy.path(gone)).unwrap();
    }
    let text = copy.succeed("blocks run @");
    assert!(text.contains("[2/7] 0000 is done") && !text.contains("0001-2 is done"), "{text}");
    assert_eq!(copy.json("model/manifest.json"), before);
    let again = copy.succeed("blocks run @");
    assert!(again.contains("[7/7] join is done"), "{again}");
}

/// Joins a damaged copy of the plan, which must fail with one line and leave the joined model as it is.
fn refuses_to_join(parts: &[&str], damage: impl FnOnce(&Folder)) {
    let copy = copied();
    let before = contents(&copy.path("model"));
    damage(&copy);
    copy.refused("blocks join @", 3, parts);
    assert!(contents(&copy.path("model")) == before);
}

#[test]
fn blocks_that_are_missing_unfinished_or_of_another_plan_are_refused_by_name() {
    refuses_to_join(&["blocks/0001-2", "is missing"], |city| {
        fs::remove_dir_all(city.join("blocks/0001-2")).unwrap();
    });
    refuses_to_join(&["block 0000-2 is not done", "blocks run"], |city| {
        fs::remove_file(city.join("blocks/0000-2/run/done.json")).unwrap();
    });
    refuses_to_join(&["blocks/0000-2", "of another plan"], |city| {
        let file = "blocks/0000-2/block.toml";
        city.write(file, city.text(file).replacen("plan = \"", "plan = \"0", 1));
    });
    copied().refused("blocks join @ --round 3", 3, &["no round 3"]);
    refuses_to_join(&["plan.toml", "is not a plan"], |city| city.write("plan.toml", "x = ["));
}

/// A file cannot be written under this path, as on a full disk. Returns its temporary name, which is taken.
#[cfg(target_os = "linux")]
fn block(path: &Path) -> PathBuf {
    let partial = PathBuf::from(format!("{}.partial", path.display()));
    fs::create_dir(&partial).unwrap();
    partial
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_stops_a_join_with_one_line_and_leaves_no_manifest_until_there_is_room() {
    let folder = copied();
    let model = folder.path("model");
    let before = contents(&folder);
    // Anew, and in place of an earlier model: from its first to its last file.
    for is_anew in [true, false] {
        for file in ["model/0/0000.ply", "model/0/0001.ply", "model/manifest.json"] {
            if is_anew {
                fs::remove_dir_all(&model).unwrap();
                fs::create_dir_all(model.join("0")).unwrap();
            }
            let partial = block(&folder.join(file));
            let blocked = folder.join(file).display().to_string();
            let parts = [&blocked, "cannot be written", "check the folder and the disk"];
            folder.refused("blocks join @", 1, &parts);
            fs::remove_dir(partial).unwrap();
            assert!(!model.join("manifest.json").exists(), "{file}: half a model with a manifest");
            // No command takes it for a model.
            folder.refused("eval @", 3, &[&folder.display().to_string()]);
            folder.succeed("blocks join @");
            assert!(contents(&folder) == before, "{file}: another model once there is room");
        }
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_stops_an_export_of_tiles_with_one_line_and_leaves_no_index_until_there_is_room() {
    let shared = shared();
    let out = shared.path("streamed-full");
    let options = "--format streamed-sog --levels 2 --chunk 1000 --out @streamed-full";
    let export = format!("export @city {options}");
    shared.succeed(&export);
    let before = contents(&out);
    // Limits the size of files, as on a full disk.
    let program = shared.command("").get_program().to_str().unwrap().to_owned();
    let line = format!("trap '' XFSZ; ulimit -f 4; exec {program} {}", shared.named(&export));
    let output = Command::new("sh").args(["-c", &line]).output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    let is_told = stderr.contains(&out.display().to_string()) && stderr.contains("the disk");
    assert!(stderr.lines().count() == 1 && is_told, "{stderr}");
    assert!(!out.join("lod-meta.json").exists(), "half a model with an index");
    // As a killed export leaves it.
    fs::write(out.join("lod-meta.json.partial"), "{").unwrap();
    shared.succeed(&export);
    assert!(contents(&out) == before, "another model once there is room");
}

#[test]
fn photographs_that_changed_since_the_plan_are_named() {
    let (copy, street) = (copied(), Folder::copy_of(&shared().join("street")));
    let photograph = fs::read_dir(street.join("low")).unwrap().next().unwrap().unwrap().path();
    let bytes = fs::read(&photograph).unwrap();
    fs::write(&photograph, [bytes, vec![0]].concat()).unwrap();
    let name = street.file_name().unwrap().to_string_lossy();
    copy.write("config.toml", copy.text("config.toml").replace("../street", &format!("../{name}")));
    copy.refused("blocks join @", 3, &[&name, "has changed since the plan"]);
}

#[test]
fn two_joins_at_once_and_blocks_of_two_devices_are_refused() {
    let copy = copied();
    let lock = fs::File::create(copy.path(".lock")).unwrap();
    lock.lock().unwrap();
    copy.refused("blocks join @", 1, &["another process"]);
    drop(lock);
    let metrics = "blocks/0001-2/run/metrics.json";
    let text = copy.text(metrics);
    assert!(text.contains("\"driver\": \""), "{text}");
    copy.write(metrics, text.replace("\"driver\": \"", "\"driver\": \"another, "));
    copy.refused("blocks join @ --same-device", 3, &["several devices"]);
    let (_, warning) = copy.run("blocks join @", 0);
    assert!(warning.contains("several devices"), "{warning}");
    assert_eq!(copy.json("model/manifest.json")["devices"].as_array().unwrap().len(), 2);
}

#[test]
fn plans_that_do_not_pay_or_cannot_be_made_are_refused_with_the_figure() {
    let shared = shared();
    // Every view of a small set shows most of it.
    shared.succeed("synth @set --views 9 --width 48 --height 36");
    shared.refuses_all(
        "
        2 | blocks plan @street --out @none --blocks 2 --law @city/law.toml | tone.law
        2 | blocks plan @street --out @none --memory 1M --plan none | 1 MiB & --memory
        3 | blocks plan @street --out @none --memory 64G --plan none | fits as a whole & nightsplat train
        3 | blocks plan @street --out @none --blocks 200 --plan none | fewer than 3 & fewer blocks
        3 | blocks plan @set --out @none --blocks 2 --plan none | seen as a whole & % & nightsplat train",
    );
    assert!(!shared.path("none").exists());
    let other = PLAN.replace("--seed 3", "--seed 4");
    shared.refused(&plan("city", &other), 2, &["contains a plan with other settings"]);
}

#[test]
fn a_law_is_read_in_place_of_measuring_and_one_of_another_set_is_refused() {
    let shared = shared();
    let given = "--law @city/law.toml --frame @city/frame.toml --steps 1 --plan none";
    shared.succeed(&format!("train @street --out @by-law {given}"));
    says(&shared.text("by-law/config.toml"), &["law.toml", "extent = "]);
    let law = shared.text("city/law.toml");
    let short: Vec<&str> = law.lines().filter(|line| !line.starts_with("005 ")).collect();
    shared.write("short.toml", short.join("\n"));
    shared.refuses_all(
        "
        2 | train @street --out @no --steps 1 --plan none --law @short.toml | lacks the view 005
        3 | train @street --out @no --steps 1 --plan none --law @city/frame.toml | is not a tone law
        3 | train @street --out @no --steps 1 --plan none --frame @city/law.toml | law.toml
        3 | train @street --out @no --steps 1 --plan none --law @city/law.toml --set tone.brightness=0.5 \
          | measured for the curve",
    );
}
