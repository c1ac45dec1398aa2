//! Scenes in blocks: plan, run, join, and what is refused.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use serde_json::Value;

use crate::common::command::{command, refused, run, succeed};

/// A street, and its plan of two blocks, trained and joined, done once.
struct City(tempfile::TempDir);

const PLAN: &str = "--blocks 2 --steps 120 --seed 3 --sh-degree 1 --max-gaussians 3000 --plan none";

fn city() -> &'static City {
    static CITY: OnceLock<City> = OnceLock::new();
    CITY.get_or_init(|| {
        let city = City(tempfile::tempdir().unwrap());
        succeed(&format!(
            "synth {} --street 16 --width 48 --height 36",
            city.path("street").display()
        ));
        succeed(&city.plan("city", PLAN));
        succeed(&format!("blocks run {}", city.path("city").display()));
        city
    })
}

impl City {
    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn plan(&self, out: &str, options: &str) -> String {
        let [street, out] = ["street", out].map(|name| self.path(name).display().to_string());
        format!("blocks plan {street} --out {out} {options}")
    }

    /// A copy of the plan with its runs, beside it.
    fn copied(&self) -> tempfile::TempDir {
        let folder = tempfile::tempdir_in(self.0.path()).unwrap();
        copy(&self.path("city"), folder.path());
        folder
    }
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let to = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &to);
        } else {
            fs::copy(entry.path(), to).unwrap();
        }
    }
}

fn files(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = vec![];
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for path in fs::read_dir(next).unwrap().map(|entry| entry.unwrap().path()) {
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().to_owned();
                found.push((name, fs::read(path).unwrap()));
            }
        }
    }
    found.sort();
    found
}

fn manifest(city: &Path) -> Value {
    serde_json::from_slice(&fs::read(city.join("model/manifest.json")).unwrap()).unwrap()
}

#[test]
fn a_plan_has_the_same_bytes_on_any_number_of_threads_and_may_be_made_again() {
    let city = city();
    for (out, threads) in [("one", "1"), ("two", "2")] {
        let output =
            command(&city.plan(out, PLAN)).env("RAYON_NUM_THREADS", threads).output().unwrap();
        assert!(output.status.success(), "{output:?}");
    }
    succeed(&city.plan("two", PLAN));
    let [one, two] = ["one", "two"].map(|out| files(&city.path(out)));
    assert_eq!(one.len(), 5 * 3 + 5, "{:?}", one.iter().map(|(name, _)| name).collect::<Vec<_>>());
    assert!(one == two, "another plan");
}

#[test]
fn a_dry_run_writes_nothing() {
    let city = city();
    let text = succeed(&city.plan("dry", &format!("{PLAN} --dry-run")));
    assert!(text.contains("2 blocks, each with") && text.contains("120 steps of"), "{text}");
    let json = succeed(&city.plan("dry", &format!("{PLAN} --dry-run --json")));
    let json: Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["block"].as_array().unwrap().len(), 4);
    let steps = |row: &Value| row["steps"].as_u64().unwrap();
    let blocks: u64 = json["block"].as_array().unwrap().iter().map(steps).sum();
    assert_eq!((steps(&json["coarse"]), blocks), (15, 105));
    assert!(!city.path("dry").exists());
}

#[test]
fn the_joined_tiles_are_those_of_the_cores_and_are_opened_like_a_run() {
    let city = city();
    let folder = city.path("city");
    let manifest = manifest(&folder);
    let tiles = manifest["tiles"].as_array().unwrap();
    let counts: u64 = tiles.iter().map(|tile| tile["count"].as_u64().unwrap()).sum();
    assert_eq!((tiles.len(), Some(counts)), (2, manifest["count"].as_u64()));
    // Along the street, the first block ends where the second begins.
    let [first, second] = [&tiles[0], &tiles[1]].map(|tile| &tile["bounds"]);
    assert!(first["to"][0].as_f64() <= second["from"][0].as_f64());
    let scores: Value =
        serde_json::from_str(&succeed(&format!("eval {} --json", folder.display()))).unwrap();
    assert_eq!(scores["gaussians"].as_u64(), Some(counts));
    assert!(scores["mean"]["psnr"].as_f64().unwrap() > 12.0, "{}", scores["mean"]);
    let exported = city.path("city.ply");
    succeed(&format!("export {} --out {}", folder.display(), exported.display()));
    let exported = String::from_utf8_lossy(&fs::read(exported).unwrap()).into_owned();
    assert!(exported.contains(&format!("element vertex {counts}\n")));
    // Tile by tile, in two levels of the same cells.
    let streamed = city.path("streamed");
    let options = "--format streamed-sog --levels 2 --chunk 1000";
    succeed(&format!("export {} {options} --out {}", folder.display(), streamed.display()));
    let index: Value =
        serde_json::from_slice(&fs::read(streamed.join("lod-meta.json")).unwrap()).unwrap();
    assert_eq!(index["lodLevels"].as_u64(), Some(2), "{index}");
}

#[test]
fn a_level_of_the_joined_model_is_those_of_its_tiles() {
    let city = city();
    let level = |from: &Path, name: &str| {
        let to = city.path(name);
        let options = "--format ply --level 1 --chunk 1000";
        succeed(&format!("export {} {options} --out {}", from.display(), to.display()));
        let bytes = fs::read(to).unwrap();
        let end = b"end_header\n";
        let header = bytes.windows(end.len()).position(|bytes| bytes == end).unwrap();
        bytes[header + end.len()..].to_vec()
    };
    let folder = city.path("city");
    let tiles = ["0000", "0001"].map(|tile| folder.join(format!("model/0/{tile}.ply")));
    let tiles = tiles.map(|tile| level(&tile, "level-of-tile.ply")).concat();
    assert!(level(&folder, "level.ply") == tiles, "cells across tiles");
}

#[test]
fn a_view_has_the_same_gain_in_every_block_and_in_a_run_on_all_views() {
    let city = city();
    let gains = |run: &Path| {
        let metrics: Value =
            serde_json::from_slice(&fs::read(run.join("metrics.json")).unwrap()).unwrap();
        metrics["target_exposure"].clone()
    };
    let whole = city.path("whole");
    let street = city.path("street");
    succeed(&format!("train {} --out {} --steps 1 --plan none", street.display(), whole.display()));
    let whole = gains(&whole);
    let mut shared = 0;
    for block in ["coarse", "blocks/0000", "blocks/0001-2"] {
        let of_block = gains(&city.path("city").join(block).join("run"));
        assert_eq!(of_block["model_gain"], whole["model_gain"], "{block}");
        for (view, gain) in of_block["gains"].as_object().unwrap() {
            assert_eq!(*gain, whole["gains"][view], "{block} {view}");
            shared += 1;
        }
    }
    assert!(shared > 80, "{shared}");
}

#[test]
fn what_is_done_is_not_done_again_and_what_was_killed_gives_the_same_model() {
    let city = city();
    let copy = city.copied();
    let before = manifest(copy.path());
    // As if the second training had been killed before its first checkpoint, and the join had not begun.
    for gone in ["blocks/0001-2/run", "model"] {
        fs::remove_dir_all(copy.path().join(gone)).unwrap();
    }
    let text = succeed(&format!("blocks run {}", copy.path().display()));
    assert!(text.contains("[2/7] 0000 is done") && !text.contains("0001-2 is done"), "{text}");
    assert_eq!(manifest(copy.path()), before);
    let again = succeed(&format!("blocks run {}", copy.path().display()));
    assert!(again.contains("[7/7] join is done"), "{again}");
}

/// Joins a damaged copy of the plan, which must fail with one line and leave the joined model as it is.
fn refuses_to_join(parts: &[&str], damage: impl FnOnce(&Path)) {
    let copy = city().copied();
    let before = files(&copy.path().join("model"));
    damage(copy.path());
    refused(&format!("blocks join {}", copy.path().display()), 3, parts);
    assert!(files(&copy.path().join("model")) == before);
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
        let path = city.join("blocks/0000-2/block.toml");
        let text = fs::read_to_string(&path).unwrap();
        let other = text.replacen("plan = \"", "plan = \"0", 1);
        fs::write(path, other).unwrap();
    });
    let copy = city().copied();
    refused(&format!("blocks join {} --round 3", copy.path().display()), 3, &["no round 3"]);
    refuses_to_join(&["plan.toml", "is not a plan"], |city| {
        fs::write(city.join("plan.toml"), "x = [").unwrap();
    });
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
    let city = city();
    let joined = city.copied();
    let (folder, model) = (joined.path(), joined.path().join("model"));
    let join = format!("blocks join {}", folder.display());
    let before = files(folder);
    // Anew, and in place of an earlier model: from its first to its last file.
    for is_anew in [true, false] {
        for file in ["model/0/0000.ply", "model/0/0001.ply", "model/manifest.json"] {
            if is_anew {
                fs::remove_dir_all(&model).unwrap();
                fs::create_dir_all(model.join("0")).unwrap();
            }
            let partial = block(&folder.join(file));
            let blocked = folder.join(file).display().to_string();
            refused(&join, 1, &[&blocked, "cannot be written", "check the folder and the disk"]);
            fs::remove_dir(partial).unwrap();
            assert!(!model.join("manifest.json").exists(), "{file}: half a model with a manifest");
            // No command takes it for a model.
            refused(&format!("eval {}", folder.display()), 3, &[&folder.display().to_string()]);
            succeed(&join);
            assert!(files(folder) == before, "{file}: another model once there is room");
        }
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_stops_an_export_of_tiles_with_one_line_and_leaves_no_index_until_there_is_room() {
    let city = city();
    let out = city.path("streamed-full");
    let options = "--format streamed-sog --levels 2 --chunk 1000";
    let export =
        format!("export {} {options} --out {}", city.path("city").display(), out.display());
    succeed(&export);
    let before = files(&out);
    // Limits the size of files, as on a full disk.
    let program = command("").get_program().to_str().unwrap().to_owned();
    let line = format!("trap '' XFSZ; ulimit -f 4; exec {program} {export}");
    let output = std::process::Command::new("sh").args(["-c", &line]).output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    let is_told = stderr.contains(&out.display().to_string()) && stderr.contains("the disk");
    assert!(stderr.lines().count() == 1 && is_told, "{stderr}");
    assert!(!out.join("lod-meta.json").exists(), "half a model with an index");
    // As a killed export leaves it.
    fs::write(out.join("lod-meta.json.partial"), "{").unwrap();
    succeed(&export);
    assert!(files(&out) == before, "another model once there is room");
}

#[test]
fn photographs_that_changed_since_the_plan_are_named() {
    let city = city();
    let copy = city.copied();
    let config = copy.path().join("config.toml");
    let street = tempfile::tempdir_in(city.path("")).unwrap();
    copy_set(&city.path("street"), street.path());
    let text = fs::read_to_string(&config).unwrap();
    let name = street.path().file_name().unwrap().to_string_lossy().into_owned();
    fs::write(&config, text.replace("../street", &format!("../{name}"))).unwrap();
    refused(
        &format!("blocks join {}", copy.path().display()),
        3,
        &[&name, "has changed since the plan"],
    );
}

fn copy_set(from: &Path, to: &Path) {
    copy(from, to);
    let photograph = fs::read_dir(to.join("low")).unwrap().next().unwrap().unwrap().path();
    let bytes = fs::read(&photograph).unwrap();
    fs::write(&photograph, [bytes, vec![0]].concat()).unwrap();
}

#[test]
fn two_joins_at_once_and_blocks_of_two_devices_are_refused() {
    let copy = city().copied();
    let lock = fs::File::create(copy.path().join(".lock")).unwrap();
    lock.lock().unwrap();
    refused(&format!("blocks join {}", copy.path().display()), 1, &["another process"]);
    drop(lock);
    let metrics = copy.path().join("blocks/0001-2/run/metrics.json");
    let text = fs::read_to_string(&metrics).unwrap();
    assert!(text.contains("\"driver\": \""), "{text}");
    fs::write(&metrics, text.replace("\"driver\": \"", "\"driver\": \"another, ")).unwrap();
    let join = format!("blocks join {}", copy.path().display());
    refused(&format!("{join} --same-device"), 3, &["several devices"]);
    let (_, warning) = run(&join, 0);
    assert!(warning.contains("several devices"), "{warning}");
    assert_eq!(manifest(copy.path())["devices"].as_array().unwrap().len(), 2);
}

#[test]
fn plans_that_do_not_pay_or_cannot_be_made_are_refused_with_the_figure() {
    let city = city();
    let plan = |options: &str| city.plan("none", options);
    let law = city.path("city/law.toml").display().to_string();
    refused(&plan(&format!("--blocks 2 --law {law}")), 2, &["tone.law"]);
    refused(&plan("--memory 1M --plan none"), 2, &["1 MiB", "--memory"]);
    refused(&plan("--memory 64G --plan none"), 3, &["fits as a whole", "nightsplat train"]);
    refused(&plan("--blocks 200 --plan none"), 3, &["fewer than 3", "fewer blocks"]);
    // Every view of a small set shows most of it.
    let [set, out] = ["set", "set-city"].map(|name| city.path(name).display().to_string());
    succeed(&format!("synth {set} --views 9 --width 48 --height 36"));
    refused(
        &format!("blocks plan {set} --out {out} --blocks 2 --plan none"),
        3,
        &["seen as a whole", "%", "nightsplat train"],
    );
    assert!(!city.path("set-city").exists() && !city.path("none").exists());
    let other = PLAN.replace("--seed 3", "--seed 4");
    refused(&city.plan("city", &other), 2, &["contains a plan with other settings"]);
}

#[test]
fn a_law_is_read_in_place_of_measuring_and_one_of_another_set_is_refused() {
    let city = city();
    let [street, run, law, frame] = ["street", "by-law", "city/law.toml", "city/frame.toml"]
        .map(|name| city.path(name).display().to_string());
    let shared = format!("--law {law} --frame {frame} --steps 1 --plan none");
    succeed(&format!("train {street} --out {run} {shared}"));
    let config = fs::read_to_string(city.path("by-law/config.toml")).unwrap();
    assert!(config.contains("law.toml") && config.contains("extent = "), "{config}");
    let text = fs::read_to_string(&law).unwrap();
    let short = city.path("short.toml");
    fs::write(
        &short,
        text.lines().filter(|line| !line.starts_with("005 ")).collect::<Vec<_>>().join("\n"),
    )
    .unwrap();
    let train = format!("train {street} --out {run}2 --steps 1 --plan none");
    refused(&format!("{train} --law {}", short.display()), 2, &["lacks the view 005"]);
    refused(&format!("{train} --law {frame}"), 3, &["is not a tone law"]);
    refused(&format!("{train} --frame {law}"), 3, &["law.toml"]);
    refused(
        &format!("{train} --law {law} --set tone.brightness=0.5"),
        3,
        &["measured for the curve"],
    );
}
