//! `bench --tune`, its file, and the tiles that training takes from it.

use crate::common::command::{Folder, json};
use crate::common::prelude::*;
use nightsplat::gpu::{BackwardForm, RecordSums, Tile};
use nightsplat::results::run;
use serde_json::json;

/// A folder with a dataset of dark photographs, whose runs read the fastest tiles from a file next to it.
fn workspace() -> Folder {
    let folder = Folder::empty();
    folder.succeed("synth @set --views 3 --width 32 --height 24");
    folder
}

impl Folder {
    /// Standard output and error of a command that must succeed with the file.
    fn tuned(&self, arguments: &str) -> (String, String) {
        let tiles = self.path("tiles.json");
        let output = self.command(arguments).env("NIGHTSPLAT_TUNE", tiles).output().unwrap();
        let [stdout, stderr] =
            [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
        assert!(output.status.success(), "{arguments}: {stderr}");
        (stdout, stderr)
    }

    /// The standard error of a new run, and the tile that it records.
    fn train(&self, run: &str, more: &str) -> (String, Tile) {
        let (_, stderr) = self.tuned(&format!("train @set --out @{run} --sh-degree 0 {more}"));
        (stderr, self.recorded(run))
    }

    fn recorded(&self, run: &str) -> Tile {
        run::load_config(&self.path(run)).unwrap().tile.unwrap()
    }

    fn keep(&self, tuning: &Value) {
        self.write("tiles.json", tuning.to_string());
    }
}

/// A file of this device with one tile for everything.
fn tuning(tile: Tile) -> Value {
    let properties = gpu().properties().clone();
    let tiles = json!([{ "channels": 3, "tile": tile }]);
    json!({ "device": properties.name, "driver": properties.driver, "tiles": tiles })
}

/// The tile without measurements.
fn built_in() -> Tile {
    RenderSettings::default().tile_on(&gpu()).unwrap()
}

/// A tile that the device supports and that is not the built-in one.
fn unusual() -> Tile {
    let backward = Some(BackwardForm { segment: 64, sums: RecordSums::Shuffles });
    Tile { subgroups: 2, backward, ..[16, 16].into() }
}

#[test]
fn tuning_times_every_supported_tile_and_saves_the_fastest() {
    let workspace = workspace();
    let arguments = "bench --tune --json --width 64 --height 48 --gaussians 300 --repeats 1";
    let printed = json(workspace.tuned(arguments).0);
    let cases = printed["cases"].as_array().unwrap();
    assert_eq!(cases.iter().map(|case| &case["channels"]).collect::<Vec<_>>(), [3, 11]);
    for tile in cases.iter().flat_map(|case| case["tiles"].as_array().unwrap()) {
        let timed: Tile = serde_json::from_value(tile["tile"].clone()).unwrap();
        assert!(gpu().properties().suits_tile(timed), "{tile}");
        assert_eq!(tile["agrees"], true, "{tile}");
        assert!(tile["rasteriser_ms"].as_f64().unwrap() > 0.0, "{tile}");
    }
    let kept = workspace.json("tiles.json");
    assert_eq!(kept["tiles"], printed["tiles"]);
    assert_eq!(kept["driver"], gpu().properties().driver.as_str());
    let chosen: Tile = serde_json::from_value(kept["tiles"][0]["tile"].clone()).unwrap();
    assert_eq!(workspace.train("run", "--steps 1").1, chosen);
}

#[test]
fn the_saved_tile_is_used_unless_another_is_set_and_a_resumed_run_keeps_its_own() {
    let workspace = workspace();
    assert_ne!(unusual(), built_in());
    assert_eq!(workspace.train("none", "--steps 1").1, built_in());
    workspace.keep(&tuning(unusual()));
    assert_eq!(workspace.train("kept", "--steps 2 --checkpoint-every 2").1, unusual());
    let [width, height] = built_in().size;
    let asked = format!("--steps 1 --set tile=[{width},{height}]");
    assert_eq!(workspace.train("asked", &asked).1, built_in());
    workspace.keep(&tuning(built_in()));
    assert_eq!(workspace.train("kept", "--steps 3 --resume --checkpoint-every 2").1, unusual());
    workspace.tuned("eval @kept");
    // In the other tests, the command's file is disabled.
    workspace.keep(&tuning(unusual()));
    workspace.succeed("train @set --out @off --steps 1");
    assert_eq!(workspace.recorded("off"), built_in());
}

#[test]
fn the_tile_is_recorded_so_that_the_same_file_gives_the_same_bits() {
    let workspace = workspace();
    workspace.keep(&tuning(unusual()));
    workspace.train("first", "--steps 20");
    workspace.keep(&tuning(built_in()));
    workspace.train("again", "--steps 20 --config @first/config.toml");
    assert_eq!(workspace.model("first"), workspace.model("again"));
}

#[test]
fn a_damaged_file_and_one_of_another_driver_are_ignored_with_one_line() {
    let workspace = workspace();
    let mut other = tuning(unusual());
    other["driver"] = json!("of another year");
    workspace.keep(&other);
    let message = |run: &str, part: &str| {
        let (stderr, tile) = workspace.train(run, "--steps 1");
        assert_eq!(tile, built_in(), "{stderr}");
        let lines: Vec<&str> = stderr.lines().filter(|line| line.contains("tiles.json")).collect();
        assert!(lines.len() == 1 && lines[0].contains(part), "{stderr}");
        assert!(lines[0].contains("bench --tune"), "{stderr}");
    };
    message("driver", "of another year");
    workspace.write("tiles.json", "{\"device\": ");
    message("damaged", "is damaged");
    workspace.keep(&tuning([3, 3].into()));
    message("unsuitable", "3x3 tiles do not suit");
}

#[test]
fn an_unsupported_tile_is_refused_with_the_remedy() {
    let workspace = workspace();
    for tile in
        ["[3,3]", "[0,8]", "[4096,4096]", "[4294967295,4294967295]", "[16,16,3]", "[16,16,1,60,0]"]
    {
        let train = format!("train @set --out @run --set tile={tile}");
        workspace.refused(&train, 2, &["tiles do not suit", "lanes", "take a tile of"]);
        assert!(!workspace.path("run").exists());
    }
}
