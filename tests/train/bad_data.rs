//! Data that would exhaust memory, corrupt a model or train nothing: it is reported, by name, beforehand.
#![cfg(feature = "cli")]
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::fs;
use std::path::{Path, PathBuf};

use nightsplat::photographs::dataset::synthetic::{self, SyntheticOptions};
use nightsplat::photographs::image::Image;
use serde_json::Value;

use crate::common::command::{refused, run};

/// Nine small views, to be corrupted.
fn small_set() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let options = SyntheticOptions {
        views: 9,
        width: 40,
        height: 30,
        seed: 2,
        ..SyntheticOptions::default()
    };
    synthetic::write(folder.path(), &options).unwrap();
    folder
}

fn train(root: &Path) -> String {
    format!("train {} --out {}/run --steps 1 --plan none", root.display(), root.display())
}

/// Asserts that training succeeds and that standard error contains all of `parts`.
fn trains_and_says(root: &Path, parts: &[&str]) {
    let (_, stderr) = run(&train(root), 0);
    for part in parts {
        assert!(stderr.contains(part), "no `{part}` in: {stderr}");
    }
}

fn edit(path: PathBuf, change: impl FnOnce(String) -> String) {
    let text = fs::read_to_string(&path).unwrap();
    fs::write(path, change(text)).unwrap();
}

#[test]
fn points_that_no_device_represents_and_views_that_show_nothing_are_reported() {
    let set = small_set();
    edit(set.path().join("colmap_sparse/0/points3D.txt"), |text| {
        text + "900001 1e39 0 0 1 2 3 0.5\n900002 0 -1e300 0 1 2 3 0.5\n900003 1e9 0 0 1 2 3 0.5\n"
    });
    trains_and_says(set.path(), &["3 of ", "points", "left out"]);

    let set = small_set();
    edit(set.path().join("transforms_train.json"), |text| {
        // The second view looks the opposite way: the x and z axes are negated.
        let mut listing: Value = serde_json::from_str(&text).unwrap();
        for row in
            listing["frames"][1]["transform_matrix"].as_array_mut().unwrap().iter_mut().take(3)
        {
            for column in [0, 2] {
                row[column] = Value::from(-row[column].as_f64().unwrap());
            }
        }
        listing.to_string()
    });
    trains_and_says(set.path(), &["view 002 contains none"]);
}

#[test]
fn images_larger_than_their_views_are_refused_before_they_are_decoded() {
    let set = small_set();
    let bomb = |path: &str| {
        Image::from_fn(1200, 900, |_, _| [0.5; 3]).save_png8(set.path().join(path)).unwrap();
    };
    bomb("high/000.png");
    refused(&train(set.path()), 3, &["high/000.png", "1200x900", "64 times"]);
}

#[test]
fn a_camera_far_from_all_others_is_named_and_training_continues() {
    let set = small_set();
    edit(set.path().join("transforms_train.json"), |text| {
        let mut listing: Value = serde_json::from_str(&text).unwrap();
        listing["frames"][2]["transform_matrix"][0][3] = Value::from(1e300);
        listing.to_string()
    });
    trains_and_says(set.path(), &["view 003 stands", "check its pose"]);
}

#[test]
fn a_depth_map_far_larger_than_its_view_is_left_out_by_name() {
    let set = small_set();
    fs::create_dir(set.path().join("depth")).unwrap();
    let map = Image::from_fn(1200, 900, |x, y| [(x + y) as f32 / 2100.0; 3]);
    map.save_png8(set.path().join("depth/001.png")).unwrap();
    let arguments = format!("{} --parts depth", train(set.path()));
    let (_, stderr) = run(&arguments, 0);
    assert!(
        stderr.contains("depth of view 001 is not used") && stderr.contains("64 times"),
        "{stderr}"
    );
}

#[test]
fn a_configuration_value_of_nan_is_refused_with_its_file_and_setting() {
    let set = small_set();
    let file = set.path().join("wrong.toml");
    fs::write(&file, "[schedule.initial_rates]\nquats = nan\n").unwrap();
    let arguments = format!("{} --config {}", train(set.path()), file.display());
    refused(&arguments, 3, &["wrong.toml", "schedule.initial_rates.quats is nan"]);
    let set_it = format!("{} --set schedule.initial_rates.quats=nan", train(set.path()));
    refused(&set_it, 2, &["schedule.initial_rates.quats is nan"]);
}
