//! `nightsplat pose`: photographs that share a camera, photographs left out, and repeated runs of COLMAP.

use super::pose::{MODELS, learned_stub, photographed, pose, stub};
use super::synthetic::*;
use crate::common::command::says;
use crate::common::prelude::*;

/// Copies a photograph and sets its equivalent focal length in Exif.
fn taken_at(path: &Path, focal: u8) {
    let exif = [
        &b"MM\0*\0\0\0\x08\0\x01\x87\x69\0\x04\0\0\0\x01\0\0\0\x1a\0\0\0\0\0\x01\xa4\x05\0\x03\0\0\0\x01\0"[..],
        &[focal],
        b"\0\0\0\0\0\0",
    ]
    .concat();
    let jpeg = fs::read(crate::common::fixture("jpeg/444.jpg")).unwrap();
    let length = (exif.len() as u16 + 8).to_be_bytes();
    let segment = [&[0xFF, 0xE1][..], &length, b"Exif\0\0", &exif].concat();
    fs::write(path, [&jpeg[..2], &segment, &jpeg[2..]].concat()).unwrap();
}

#[test]
fn photographs_of_one_size_lens_and_focal_length_share_a_camera() {
    let root = &Folder::empty();
    let photos = root.join("photos");
    fs::create_dir_all(&photos).unwrap();
    for index in 0..6 {
        let focal = if index % 2 == 0 { 37 } else { 75 };
        taken_at(&photos.join(format!("{index}.jpg")), focal);
    }
    photograph(&photos.join("other.png"), SIZE, 0.05);
    photograph(&photos.join("another.png"), (32, 20), 0.05);
    stub(root, "feature_extractor) { tr '\\n' ' ' < $list; echo; } >> $root/lists;;");
    says(&root.run(&pose(""), 3).1, &["3 groups of photographs by size, lens and focal length"]);
    let lists = root.text("lists");
    let lists: BTreeSet<&str> = lists.lines().map(str::trim).collect();
    let expected = ["0.jpg 2.jpg 4.jpg", "1.jpg 3.jpg 5.jpg", "another.png other.png"];
    assert_eq!(lists, BTreeSet::from(expected));
}

#[test]
fn a_photograph_that_does_not_decode_is_left_out_and_hidden_files_are_ignored() {
    let root = &Folder::empty();
    let photos = photographed(root);
    root.write("photos/broken.jpg", "no photograph");
    root.write("photos/._v00.png", "Mac OS X");
    photograph(&photos.join("dynamic_mask_v01.png"), SIZE, 1.0);
    model(9).write_binary(&root.join("models/0"));
    stub(root, MODELS);
    let (stdout, stderr) = root.run(&pose(""), 0);
    says(&stdout, &["9 of 9 photographs with their cameras, one calibrated"]);
    says(&stderr, &["left out: ", "broken.jpg"]);
    assert!(!stderr.contains("._v00"), "{stderr}");
    let dataset = load(&root.join("scene"));
    let masked: Vec<bool> = dataset.views.iter().map(|view| view.mask.is_some()).collect();
    // All of it is masked, so nothing is left to train on.
    assert_eq!((dataset.views.len(), masked.contains(&true)), (8, false));
}

#[test]
fn an_implausible_calibration_is_reported() {
    let root = &Folder::empty();
    photographed(root);
    stub(root, MODELS);
    let posed = |fy: f64, code: i32| {
        let cameras = vec![(3, "PINHOLE", 1, vec![35.0, fy, 20.0, 15.0])];
        Model { cameras, ..model(9) }.write_binary(&root.join("models/0"));
        root.run(&pose("--overwrite"), code)
    };
    for (fy, is_plausible) in [(36.0, true), (60.0, false)] {
        let (stdout, stderr) = posed(fy, 0);
        let warned = stderr.contains("is implausible: its focal lengths are 71 % apart");
        assert_eq!(warned, !is_plausible, "{stderr}");
        says(&stdout, &["40x30 with focal length 35"]);
    }
    fs::remove_dir_all(root.join("scene")).unwrap();
    let (_, stderr) = posed(93.0, 3);
    let error = stderr.lines().find(|line| line.starts_with("error: ")).unwrap();
    let cannot_be = "photos: COLMAP's calibration cannot be, 40x30 with focal length 35 x 93";
    says(error, &[cannot_be, "2.7 times", "--camera-model"]);
    assert!(!root.join("scene").exists() && root.join("scene.colmap.log").is_file());
}

#[test]
fn a_camera_that_few_points_hold_is_left_out_and_said() {
    let root = &Folder::empty();
    photographed(root);
    let mut model = model(9);
    for (index, (_, _, seen_by)) in model.points.iter_mut().enumerate() {
        let first = if index < 6 { 7 } else { 8 };
        *seen_by = (first..16).collect();
    }
    model.write_binary(&root.join("models/0"));
    stub(root, MODELS);
    let (stdout, stderr) = root.run(&pose(""), 0);
    says(&stdout, &["8 of 9 photographs with their cameras"]);
    let left_out = "left out: v00.png (6); half of all photographs see 20";
    assert!(stderr.contains(left_out) && !stderr.contains("have no camera"), "{stderr}");
    let dataset = load(&root.join("scene"));
    let names: BTreeSet<&str> = dataset.views.iter().map(|view| view.name.as_str()).collect();
    assert!(names.len() == 8 && !names.contains("v00"), "{names:?}");
}

#[test]
fn what_is_burnt_in_has_no_features_and_is_masked_in_the_dataset() {
    let root = &Folder::empty();
    let (photos, out, seen) = (photographed(root), root.join("scene"), root.join("seen"));
    let is_text = |x: u32, y: u32| (2..22).contains(&x) && (25..29).contains(&y);
    for index in 0..9 {
        let value = |x: u32, y: u32| match is_text(x, y) {
            true => f32::from(u8::from(x % 5 < 2)),
            false => {
                0.1 * ((((x + 7 * index) / 4) * 7 + (y + 5 * index) / 3 * 13) % 11) as f32 / 11.0
            }
        };
        let picture = Image::from_fn(SIZE.0, SIZE.1, |x, y| [value(x, y); 3]);
        picture.save_png8(photos.join(format!("v{index:02}.png"))).unwrap();
    }
    photograph(&photos.join("masks/v03.png"), SIZE, 1.0);
    photograph(&photos.join("masks/v04.png"), SIZE, 0.0);
    model(9).write_binary(&root.join("models/0"));
    stub(root, &format!("feature_extractor) cp -r $masks $root/seen;;\n{MODELS}"));
    says(&root.run(&pose(""), 0).1, &[" % of the photographs of 40x30 hardly changes"]);
    let shown =
        |mask: &Path, x: u32, y: u32| Image::load(mask).unwrap().data[(40 * y + x) as usize] > 0.0;
    for mask in [seen.join("v03.png.png"), seen.join("v08.png.png"), out.join("masks/v08.png")] {
        let pixels = || (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y)));
        assert!(pixels().all(|(x, y)| !is_text(x, y) || !shown(&mask, x, y)), "{mask:?}");
        assert!(pixels().all(|(x, y)| y > 20 || shown(&mask, x, y)), "{mask:?}");
    }
    // Masks of the photographs count for both, and stay as they are in the dataset.
    assert!(!shown(&seen.join("v04.png.png"), 0, 0));
    assert!(shown(&out.join("masks/v03.png"), 5, 25));
    let dataset = load(&out);
    let masked = dataset.views.iter().filter(|view| view.mask.is_some());
    let masked: Vec<&str> = masked.map(|view| view.name.as_str()).collect();
    assert_eq!(masked, ["v00", "v01", "v02", "v05", "v06", "v07", "v08"]);
}

#[test]
fn a_dim_dashboard_has_no_features() {
    let root = &Folder::empty();
    let (photos, seen) = (photographed(root), root.join("seen"));
    let (width, height) = (320, 240);
    // Instruments of four codes in black, below a scene of thirty.
    let is_lit = |x: u32, y: u32| {
        let (dx, dy) = ((x % 80).abs_diff(40), y.abs_diff(210));
        (250..600).contains(&(dx * dx + dy * dy)) && (x + y) % 5 < 3
    };
    for index in 0..9_u32 {
        let noise = |x: u32, y: u32| ((x * 7919 + y * 104_729 + index * 1_299_709) >> 3) % 3;
        let code = |x: u32, y: u32| match y {
            184.. => {
                if is_lit(x, y) {
                    4
                } else {
                    0
                }
            }
            _ => ((x + 31 * index) / 9 * 7 + (y + 17 * index) / 7 * 13) % 11 * 3,
        };
        let value = |x: u32, y: u32| (code(x, y) + noise(x, y)) as f32 / 255.0;
        let picture = Image::from_fn(width, height, |x, y| [value(x, y); 3]);
        picture.save_png8(photos.join(format!("v{index:02}.png"))).unwrap();
    }
    model(9).write_binary(&root.join("models/0"));
    stub(root, &format!("feature_extractor) cp -r $masks $root/seen;;\n{MODELS}"));
    says(&root.run(&pose(""), 0).1, &["hardly changes between views that move"]);
    let mask = Image::load(seen.join("v08.png.png")).unwrap();
    let pixels = || (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let is_shown = |x: u32, y: u32| mask.data[(width * y + x) as usize] > 0.0;
    assert!(pixels().all(|(x, y)| y < 184 || !is_lit(x, y) || !is_shown(x, y)), "instruments");
    assert!(pixels().all(|(x, y)| y >= 168 || is_shown(x, y)), "the scene");
}

#[test]
fn few_photographs_start_from_a_closer_pair_and_options_go_to_their_command() {
    let root = &Folder::empty();
    photographed(root);
    model(9).write_binary(&root.join("models/0"));
    let for_angle = |angle: u32| {
        let copy = "cp -r $root/models/* $output";
        stub(root, &format!("mapper) [ \"$angle\" = {angle} ] && {copy}; exit 0;;"));
    };
    for_angle(2);
    let (stdout, stderr) = root.run(&pose(""), 0);
    says(&stdout, &["9 of 9 photographs"]);
    assert_eq!(stderr.matches("registering again, from a closer pair").count(), 2, "{stderr}");
    let relaxed = "--Mapper.init_max_forward_motion 1 --Mapper.init_min_num_inliers 50";
    says(&root.text("scene/colmap.log"), &[relaxed]);

    // The user's value is the only one.
    for_angle(3);
    let asked = |option: &str| pose(&format!("--overwrite --colmap-option {option}"));
    root.succeed(&asked("Mapper.init_min_tri_angle=3"));
    let log = root.text("scene/colmap.log");
    assert_eq!(log.matches("init_min_tri_angle").count(), 1, "{log}");
    let none_has = "none of feature_extractor, exhaustive_matcher, mapper has";
    root.refused(&asked("Mapper.nothing=3"), 2, &["Mapper.nothing", none_has]);
    let valueless = ["Mapper.init_min_tri_angle", "is not NAME=VALUE"];
    root.refused(&asked("Mapper.init_min_tri_angle"), 2, &valueless);
}

#[test]
fn learned_features_are_tried_where_most_photographs_have_no_camera() {
    let root = &Folder::empty();
    photographed(root);
    model(4).write_binary(&root.join("some/0"));
    model(9).write_binary(&root.join("all/0"));
    learned_stub(
        root,
        "mapper) case $database in */learned-*) cp -r $root/all/* $output;; *) cp -r $root/some/* $output;; esac;;",
    );
    let (stdout, stderr) = root.run(&pose(""), 0);
    says(&stdout, &["9 of 9 photographs"]);
    let plan = "SIFT features; if most photographs have no camera, learned ones too";
    says(&stderr, &[plan, "4 of 9 have a camera: learned features, for at most 2 min"]);
    assert!(!stderr.contains("matching again"), "{stderr}");
    let log = root.text("scene/colmap.log");
    for option in
        ["--FeatureExtraction.type ALIKED_N16ROT", "--FeatureMatching.type ALIKED_LIGHTGLUE"]
    {
        assert_eq!(log.matches(option).count(), 1, "{option}: {log}");
    }

    // On request, they are the first and only ones.
    let (_, stderr) = root.run(&pose("--overwrite --features learned"), 0);
    says(&stderr, &["learned features: ALIKED, matched by LightGlue"]);
    let log = root.text("scene/colmap.log");
    assert_eq!((log.matches("$ ").count(), log.matches("ALIKED_N16ROT").count()), (3, 1), "{log}");
    // With SIFT asked for, none are tried.
    let (_, stderr) = root.run(&pose("--overwrite --features sift --patience 0.1"), 0);
    assert!(!stderr.contains("learned"), "{stderr}");
}

#[test]
fn a_colmap_without_learned_features_or_their_networks_is_told_with_the_remedy() {
    let root = &Folder::empty();
    photographed(root);
    let ask = pose("--features learned");
    stub(root, MODELS);
    let without = "--features learned: this COLMAP has no ALIKED features";
    root.refused(&ask, 2, &[without, "--colmap PATH", "--features sift"]);
    assert!(!root.join("scene").exists());
    let onnx = "ALIKED feature extraction requires ONNX support.";
    for (printed, parts) in [
        (onnx, ["built without ONNX", "--features sift"]),
        ("Check failed: Failed to download file", ["could not fetch", "n16rot_model_path=FILE"]),
    ] {
        learned_stub(root, &format!("feature_extractor) echo '{printed}' >&2; exit 1;;"));
        let (_, stderr) = root.run(&ask, 2);
        says(stderr.lines().last().unwrap(), &parts);
    }
    // What is tried without being asked for is a warning, and SIFT goes on.
    model(4).write_binary(&root.join("some/0"));
    model(9).write_binary(&root.join("all/0"));
    learned_stub(
        root,
        "feature_extractor) case $database in */learned-*) echo 'requires ONNX support' >&2; exit 1;; esac;;\n\
         mapper) case $database in */guided.db) cp -r $root/all/* $output;; *) cp -r $root/some/* $output;; esac;;",
    );
    let (stdout, stderr) = root.run(&pose(""), 0);
    says(&stdout, &["9 of 9 photographs"]);
    let told = ["built without ONNX", "going on with SIFT", "4 of 9 have a camera: matching again"];
    says(&stderr, &told);
}

#[test]
fn an_archive_of_photographs_is_read_in_place() {
    let root = &Folder::empty();
    pack(&photographed(root), &root.join("photos.zip"), "scan/");
    model(9).write_binary(&root.join("models/0"));
    stub(root, MODELS);
    says(&root.succeed(&pose("").replace("@photos", "@photos.zip")), &["9 of 9 photographs"]);
    assert_eq!(load(&root.join("scene")).views.len(), 9);
}
