//! `nightsplat pose` as a shell runs it, with a program that stands in for COLMAP.

use super::stub::{MODELS, bright, is_installed, mean, mixed, nothing_is_left, photographed, stub};
use super::synthetic::*;
use crate::common::command::says;
use crate::common::prelude::*;

/// The command for `photos` with the stub, and these options.
pub(super) fn pose(options: &str) -> String {
    format!("pose @photos --out @scene --colmap @colmap-stub {options}")
}

#[test]
fn the_dark_photographs_get_the_cameras_of_the_largest_model() {
    let root = &Folder::empty();
    let (photos, out) = (photographed(root), root.join("scene"));
    model(2).write_binary(&root.join("models/0"));
    model(8).write_binary(&root.join("models/1"));
    stub(root, "mapper) cp -r $root/models/* $output; cp -r $images $root/seen;;");
    let (stdout, stderr) = root.run(&pose(""), 0);
    says(&stdout, &["8 of 9 photographs", "nightsplat train"]);
    let stages =
        ["9 photographs brightened", "features extracted", "features matched", "cameras placed"];
    says(&stderr, &stages);
    for index in 0..8 {
        let file = name(index) + ".png";
        let [dark, kept] =
            [&photos, &out.join("images")].map(|folder| fs::read(folder.join(&file)).unwrap());
        assert_eq!(dark, kept, "{file}");
        assert!(
            mean(&root.join("seen").join(&file)) > 4.0 * mean(&photos.join(&file)),
            "COLMAP sees {file} in the dark"
        );
    }
    assert!(!out.join("images/v08.png").exists() && !out.join("work").exists());
    says(&root.text("scene/colmap.log"), &["$ "]);
    let dataset = load(&out);
    assert_eq!((dataset.views.len(), dataset.points.len()), (8, 20));
    // An existing folder is kept, unless `pose` wrote it and may replace it.
    root.refused(&pose(""), 1, &["scene", "exists already", "--overwrite"]);
    root.succeed(&pose("--overwrite"));
    fs::remove_file(out.join("colmap.log")).unwrap();
    root.refused(&pose("--overwrite"), 1, &["exists already; choose another folder"]);
}

#[test]
fn what_was_placed_and_calibrated_is_counted() {
    let root = &Folder::empty();
    photographed(root);
    bright(root);
    mixed().write_binary(&root.join("models/0"));
    stub(root, MODELS);
    let found = "5 of 9 photographs and 3 of 4 bright ones with their cameras, one calibrated (";
    says(&root.succeed(&pose("--with @day")), &[found, "40x30 with focal length 35"]);
}

#[test]
fn problems_before_the_start_are_reported_in_a_line() {
    let root = &Folder::empty();
    let photos = photographed(root);
    fs::create_dir(root.join("empty")).unwrap();
    root.write("clip.mp4", "no clip");
    root.write("no.mp4", "");
    fs::create_dir(root.join("twice")).unwrap();
    for copy in ["twice/v00.png", "twice/v00.webp", "twice/v01.png"] {
        fs::copy(photos.join("v01.png"), root.join(copy)).unwrap();
    }
    (0..9).for_each(|i| photograph(&root.join(format!("black/{}.png", name(i))), SIZE, 0.0));
    let absent = "pose @photos --out @scene --colmap /nowhere/colmap";
    let remedies =
        ["`/nowhere/colmap` is not found", "apt install colmap", "brew install", "--colmap PATH"];
    root.refused(absent, 2, &remedies);
    assert!(root.run(absent, 2).1.len() < 240, "a short line");
    let ffmpeg = "`/nowhere/ffmpeg` is & apt install ffmpeg & --ffmpeg PATH";
    let glomap = "`/nowhere/glomap` is not found & COLMAP 4.0 & --glomap PATH";
    let none_has = "none of feature_extractor, exhaustive_matcher, mapper has";
    let learned = "--features learned: this COLMAP has no ALIKED features";
    let of_true = "--out @scene --colmap true";
    root.refuses_all(&format!(
        "3 | train @photos --out @run | 9 photographs & nightsplat pose & --out DATASET
         2 | {absent} --patience -1 | --patience
         3 | pose @absent {of_true} | absent & cannot be read
         3 | pose @empty {of_true} | contains 0 photographs
         2 | pose @photos {of_true} --fps 0 | --fps
         2 | pose @clip.mp4 {of_true} --ffmpeg /nowhere/ffmpeg | {ffmpeg}
         3 | pose @clip.mp4 {of_true} --ffmpeg false | clip.mp4: is no clip & false & ended with & pass a clip
         3 | pose @no.mp4 {of_true} --ffmpeg false | no.mp4: is no clip & the file is empty & pass a clip
         3 | pose @twice {of_true} | v00.png and v00.webp have the same name
         3 | pose @black {of_true} | /black & black
         2 | pose @photos {of_true} --mapper global --glomap /nowhere/glomap | {glomap}
         2 | pose @photos {of_true} --colmap-option Mapper.nothing=3 | Mapper.nothing & {none_has}
         2 | pose @photos {of_true} --colmap-option Mapper.init_min_tri_angle | min_tri_angle & is not NAME=VALUE
         2 | pose @photos {of_true} --features learned | {learned} & --colmap PATH & --features sift
         2 | pose @photos {of_true} --with @twice --matcher sequential | --matcher sequential & take exhaustive
         3 | pose @photos {of_true} --with @photos | photos & is the folder of the dark photographs itself
         3 | pose @photos {of_true} --with @none | none"
    ));
    nothing_is_left(root);
}

#[test]
#[ignore = "two minutes: of `make stress`"]
fn real_dark_photographs_train_as_well_with_cameras_from_colmap_as_with_supplied_ones() {
    let Some(chair) = shared("data/lom/chair") else { return };
    if !is_installed("colmap") {
        return;
    }
    let folder = Folder::empty();
    let held_out = names(&load(&chair), Split::Test).join("\n");
    let chair = chair.display();
    folder.succeed(&format!("pose {chair}/low --out @scene"));
    assert_eq!(load(&folder.join("scene")).views.len(), 48);
    folder.write("scene/test.txt", held_out);
    let trained = |set: &str, out: &str| {
        let options = "--downscale 4 --steps 1000 --seed 1";
        folder.succeed(&format!("train {set} {options} --out @{out}"));
        folder.json(&format!("{out}/metrics.json"))["mean"]["psnr"].as_f64().unwrap()
    };
    let found = trained(&format!("@scene --reference {chair}/high"), "found");
    let given = trained(&chair.to_string(), "given");
    println!("{found:.2} dB with the cameras that COLMAP finds, {given:.2} dB with those supplied");
    assert!(found > given - 0.3);
}
