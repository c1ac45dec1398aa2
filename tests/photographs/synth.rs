//! The command `synth`.

use crate::common::command::{file_names, json};
use crate::common::prelude::*;
use crate::common::{Folder, says};

#[test]
fn the_same_options_make_the_same_set_twice_and_others_another() {
    let small = "--views 3 --width 24 --height 16";
    let night = "--views 3 --width 80 --height 60 --bands --brackets";
    let lamps = ["--lamp", "--lamp=16", "--lamp=40 --fisheye"];
    let nights = ["--sky --headlights", "--sky --headlights", "--haze --seed 1", ""];
    let both = ["low/001.png", "high/001.png", "colmap_sparse/0/points3D.txt"];
    for (size, sets, files) in [
        (small, &lamps[..], &[&both[..], &["lit/000.png"]].concat()),
        (night, &nights, &both.to_vec()),
    ] {
        let folder = Folder::empty();
        for (at, more) in sets.iter().enumerate() {
            folder.run(&format!("synth @{at} {size} {more}"), 0);
        }
        for file in files {
            let read = |at: usize| folder.read(&format!("{at}/{file}"));
            assert!(read(0) == read(1), "{file}");
            assert!((2..sets.len()).all(|other| read(other) != read(0)), "{file}");
        }
        if sets.len() > 3 {
            let lights = [0, 1, 2].map(|view| {
                let image = Image::load(folder.join(format!("3/low/{view:03}.png"))).unwrap();
                let light = image.data.iter().map(|&value| f64::from(linear_from_srgb(value)));
                light.sum::<f64>()
            });
            for pair in lights.windows(2) {
                assert!((3.0..5.0).contains(&(pair[1] / pair[0])), "{lights:?}");
            }
        }
    }
}

#[test]
fn a_set_that_cannot_be_made_is_refused_in_one_line() {
    let folder = Folder::empty();
    folder.refuses_all(
        "2 | synth @set --lamp=4 | 5 to 80 & 4
         2 | synth @set --lamp=81 | 5 to 80 & 81
         2 | synth @set --lamp=NaN | 5 to 80 & NaN
         2 | synth @set --lamp=-3 | 5 to 80 & -3
         2 | synth @set --brackets=nan | -10 to 10
         2 | synth @set --lamp --sky | leave out --lamp",
    );
    assert!(folder.run("synth @set --street 2 --fisheye", 2).1.contains("--fisheye"));
    assert!(!folder.join("set").exists());
}

#[test]
fn a_set_has_six_views_of_128x96_a_plot_unless_told_otherwise() {
    let folder = Folder::empty();
    for (options, part) in [
        ("--street 1", "6 views of 128x96"),
        ("--street 2 --views 4 --width 32 --height 16", "4 views of 32x16"),
    ] {
        let line = folder.succeed(&format!("synth @set {options} --overwrite"));
        assert!(line.contains(part), "{line}");
    }
    let options = SyntheticOptions { normals: true, ..small_set(10, [48, 36], 5) };
    nightsplat_synth::write(folder.join("library"), &options).unwrap();
    folder.run("synth @normals --views 10 --width 48 --height 36 --seed 5 --normals", 0);
    for file in ["low/003.png", "normals/003.png"] {
        let [ours, expected] =
            ["normals", "library"].map(|set| folder.read(&format!("{set}/{file}")));
        assert!(ours == expected, "{file}");
    }
}

#[test]
fn a_folder_that_is_not_empty_is_kept_unless_overwritten_and_a_missing_one_is_created() {
    let folder = Folder::empty();
    folder.write("set/letter.txt", "mine");
    let small = "--views 3 --width 16 --height 16";
    folder.refused(&format!("synth @set {small}"), 1, &["is not empty", "--overwrite"]);
    assert_eq!(file_names(folder.join("set")), ["letter.txt"]);
    folder.run(&format!("synth @set {small} --overwrite"), 0);
    assert_eq!(folder.text("set/letter.txt"), "mine");
    folder.run(&format!("synth @new {small}"), 0);
    assert!(folder.join("new/transforms_train.json").is_file());
}

#[test]
fn a_fisheye_set_trains_renders_scores_and_exports() {
    let folder = Folder::empty();
    folder.run("synth @set --fisheye --views 10 --width 48 --height 36", 0);
    let message = folder.run("train @set --out @native --steps 200 --seed 1", 0).1;
    assert!(!message.contains("cropped"), "{message}");
    let message = folder.run("train @set --out @undistorted --steps 1 --undistort", 0).1;
    says(&message, &["fisheye", "60 degrees"]);
    let scores = json(folder.succeed("eval @native --json"));
    let psnr = scores["mean"]["psnr"].as_f64().unwrap_or_else(|| panic!("{scores}"));
    assert!(psnr > 15.0, "{psnr}");
    folder.run("render @native --path interpolate --frames 2 --out @frames", 0);
    for (to, name) in [("ply", "model.ply"), ("html", "page.html")] {
        folder.run(&format!("export @native --format {to} --out @{name}"), 0);
        assert!(folder.join(name).exists());
    }
}
