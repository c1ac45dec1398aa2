//! `nightsplat pose`: photographs that share a camera, photographs left out, and repeated runs of COLMAP.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use nightsplat_photographs::image::{Image, ImageFile};

use super::pose::{learned_stub, line, models, photographed, stub};
use super::synthetic::*;
use crate::common::command::{refused, run, says};

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
    let lists = root.join("lists");
    let cases =
        format!("feature_extractor) {{ tr '\\n' ' ' < $list; echo; }} >> {};;", lists.display());
    let colmap = stub(root, &cases);
    let (_, stderr) = run(&line(&photos, &root.join("scene"), &colmap, ""), 3);
    assert!(stderr.contains("3 groups of photographs by size, lens and focal length"), "{stderr}");
    let lists = fs::read_to_string(lists).unwrap();
    let lists: BTreeSet<&str> = lists.lines().map(str::trim).collect();
    let expected = ["0.jpg 2.jpg 4.jpg", "1.jpg 3.jpg 5.jpg", "another.png other.png"];
    assert_eq!(lists, BTreeSet::from(expected));
}

#[test]
fn a_photograph_that_does_not_decode_is_left_out_and_hidden_files_are_ignored() {
    let root = &Folder::empty();
    let (photos, out) = (photographed(root), root.join("scene"));
    fs::write(photos.join("broken.jpg"), "no photograph").unwrap();
    fs::write(photos.join("._v00.png"), "Mac OS X").unwrap();
    photograph(&photos.join("dynamic_mask_v01.png"), SIZE, 1.0);
    model(9).write_binary(&root.join("models/0"));
    let colmap = stub(root, &models(root));
    let arguments = line(&photos, &out, &colmap, "");
    let (stdout, stderr) = run(&arguments, 0);
    assert!(stdout.contains("9 of 9 photographs with their cameras, one calibrated"), "{stdout}");
    says(&stderr, &["left out: ", "broken.jpg"]);
    assert!(!stderr.contains("._v00"), "{stderr}");
    let dataset = load(&out);
    let masked: Vec<bool> = dataset.views.iter().map(|view| view.mask.is_some()).collect();
    // All of it is masked, so nothing is left to train on.
    assert_eq!((dataset.views.len(), masked.contains(&true)), (8, false));
}

#[test]
fn an_implausible_calibration_is_reported() {
    let root = &Folder::empty();
    let photos = photographed(root);
    for (out, fy, is_plausible) in [("good", 36.0, true), ("bad", 60.0, false)] {
        let cameras = vec![(3, "PINHOLE", 1, vec![35.0, fy, 20.0, 15.0])];
        Model { cameras, ..model(9) }.write_binary(&root.join("models/0"));
        let colmap = stub(root, &models(root));
        let out = root.join(out);
        let arguments = line(&photos, &out, &colmap, "");
        let (stdout, stderr) = run(&arguments, 0);
        assert_eq!(
            stderr.contains("is implausible: its focal lengths are 71 % apart"),
            !is_plausible,
            "{stderr}"
        );
        assert!(stdout.contains("40x30 with focal length 35"), "{stdout}");
    }
    let cameras = vec![(3, "PINHOLE", 1, vec![35.0, 93.0, 20.0, 15.0])];
    Model { cameras, ..model(9) }.write_binary(&root.join("models/0"));
    let arguments = line(&photos, &root.join("none"), &stub(root, &models(root)), "");
    let (_, stderr) = run(&arguments, 3);
    let error = stderr.lines().find(|line| line.starts_with("error: ")).unwrap();
    says(
        &error,
        &[
            "photos: COLMAP's calibration cannot be, 40x30 with focal length 35 x 93",
            "2.7 times",
            "--camera-model",
        ],
    );
    assert!(!root.join("none").exists() && root.join("none.colmap.log").is_file());
}

#[test]
fn a_camera_that_few_points_hold_is_left_out_and_said() {
    let root = &Folder::empty();
    let (photos, out) = (photographed(root), root.join("scene"));
    let mut model = model(9);
    for (index, (_, _, seen_by)) in model.points.iter_mut().enumerate() {
        let first = if index < 6 { 7 } else { 8 };
        *seen_by = (first..16).collect();
    }
    model.write_binary(&root.join("models/0"));
    let (stdout, stderr) = run(&line(&photos, &out, &stub(root, &models(root)), ""), 0);
    assert!(stdout.contains("8 of 9 photographs with their cameras"), "{stdout}");
    let left_out = "left out: v00.png (6); half of all photographs see 20";
    assert!(stderr.contains(left_out) && !stderr.contains("have no camera"), "{stderr}");
    let dataset = load(&out);
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
    let cases = format!("feature_extractor) cp -r $masks {};;\n{}", seen.display(), models(root));
    let (_, stderr) = run(&line(&photos, &out, &stub(root, &cases), ""), 0);
    assert!(stderr.contains(" % of the photographs of 40x30 hardly changes"), "{stderr}");
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
    let cases = format!("feature_extractor) cp -r $masks {};;\n{}", seen.display(), models(root));
    let (_, stderr) = run(&line(&photos, &root.join("scene"), &stub(root, &cases), ""), 0);
    assert!(stderr.contains("hardly changes between views that move"), "{stderr}");
    let mask = Image::load(seen.join("v08.png.png")).unwrap();
    let pixels = || (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let is_shown = |x: u32, y: u32| mask.data[(width * y + x) as usize] > 0.0;
    assert!(pixels().all(|(x, y)| y < 184 || !is_lit(x, y) || !is_shown(x, y)), "instruments");
    assert!(pixels().all(|(x, y)| y >= 168 || is_shown(x, y)), "the scene");
}

#[test]
fn few_photographs_start_from_a_closer_pair_and_options_go_to_their_command() {
    let root = &Folder::empty();
    let (photos, out) = (photographed(root), root.join("scene"));
    model(9).write_binary(&root.join("models/0"));
    let copy = format!("cp -r {}/models/* $output", root.display());
    let pose = |cases: &str, more: &str| {
        line(&photos, &out, &stub(root, cases), &format!("--overwrite {more}"))
    };
    let relaxed = format!("mapper) [ \"$angle\" = 2 ] && {copy}; exit 0;;");
    let (stdout, stderr) = run(&pose(&relaxed, ""), 0);
    assert!(stdout.contains("9 of 9 photographs"), "{stdout}");
    assert_eq!(stderr.matches("registering again, from a closer pair").count(), 2, "{stderr}");
    let log = fs::read_to_string(out.join("colmap.log")).unwrap();
    assert!(
        log.contains("--Mapper.init_max_forward_motion 1 --Mapper.init_min_num_inliers 50"),
        "{log}"
    );

    // The user's value is the only one.
    let asked = format!("mapper) [ \"$angle\" = 3 ] && {copy}; exit 0;;");
    run(&pose(&asked, "--colmap-option Mapper.init_min_tri_angle=3"), 0);
    let log = fs::read_to_string(out.join("colmap.log")).unwrap();
    assert_eq!(log.matches("init_min_tri_angle").count(), 1, "{log}");
    for (option, parts) in [
        (
            "Mapper.nothing=3",
            ["Mapper.nothing", "none of feature_extractor, exhaustive_matcher, mapper has"],
        ),
        ("Mapper.init_min_tri_angle", ["Mapper.init_min_tri_angle", "is not NAME=VALUE"]),
    ] {
        refused(&pose(&asked, &format!("--colmap-option {option}")), 2, &parts);
    }
}

#[test]
fn learned_features_are_tried_where_most_photographs_have_no_camera() {
    let root = &Folder::empty();
    let (photos, out) = (photographed(root), root.join("scene"));
    model(4).write_binary(&root.join("some/0"));
    model(9).write_binary(&root.join("all/0"));
    let cases = format!(
        "mapper) case $database in */learned-*) cp -r {0}/all/* $output;; *) cp -r {0}/some/* $output;; esac;;",
        root.display()
    );
    let (stdout, stderr) = run(&line(&photos, &out, &learned_stub(root, &cases), ""), 0);
    assert!(stdout.contains("9 of 9 photographs"), "{stdout}");
    let plan = "SIFT features; if most photographs have no camera, learned ones too";
    for told in [plan, "4 of 9 have a camera: learned features, for at most 2 min"] {
        assert!(stderr.contains(told), "no `{told}` in: {stderr}");
    }
    assert!(!stderr.contains("matching again"), "{stderr}");
    let log = fs::read_to_string(out.join("colmap.log")).unwrap();
    for option in
        ["--FeatureExtraction.type ALIKED_N16ROT", "--FeatureMatching.type ALIKED_LIGHTGLUE"]
    {
        assert_eq!(log.matches(option).count(), 1, "{option}: {log}");
    }

    // On request, they are the first and only ones.
    let learned = "--overwrite --features learned";
    let (_, stderr) = run(&line(&photos, &out, &learned_stub(root, &cases), learned), 0);
    assert!(stderr.contains("learned features: ALIKED, matched by LightGlue"), "{stderr}");
    let log = fs::read_to_string(out.join("colmap.log")).unwrap();
    assert_eq!((log.matches("$ ").count(), log.matches("ALIKED_N16ROT").count()), (3, 1), "{log}");
    // With SIFT asked for, none are tried.
    let sift = "--overwrite --features sift --patience 0.1";
    let (_, stderr) = run(&line(&photos, &out, &learned_stub(root, &cases), sift), 0);
    assert!(!stderr.contains("learned"), "{stderr}");
}

#[test]
fn a_colmap_without_learned_features_or_their_networks_is_told_with_the_remedy() {
    let root = &Folder::empty();
    let (photos, out) = (photographed(root), root.join("scene"));
    let ask = |colmap: &Path| line(&photos, &out, colmap, "--features learned");
    let parts = [
        "--features learned: this COLMAP has no ALIKED features",
        "--colmap PATH",
        "--features sift",
    ];
    refused(&ask(&stub(root, &models(root))), 2, &parts);
    assert!(!out.exists());
    for (printed, parts) in [
        (
            "ALIKED feature extraction requires ONNX support.",
            ["built without ONNX", "--features sift"],
        ),
        ("Check failed: Failed to download file", ["could not fetch", "n16rot_model_path=FILE"]),
    ] {
        let fails = format!("feature_extractor) echo '{printed}' >&2; exit 1;;");
        let (_, stderr) = run(&ask(&learned_stub(root, &fails)), 2);
        let error = stderr.lines().last().unwrap();
        assert!(parts.iter().all(|part| error.contains(part)), "{error}");
    }
    // What is tried without being asked for is a warning, and SIFT goes on.
    model(4).write_binary(&root.join("some/0"));
    model(9).write_binary(&root.join("all/0"));
    let cases = format!(
        "feature_extractor) case $database in */learned-*) echo 'requires ONNX support' >&2; exit 1;; esac;;\n\
         mapper) case $database in */guided.db) cp -r {0}/all/* $output;; *) cp -r {0}/some/* $output;; esac;;",
        root.display()
    );
    let (stdout, stderr) = run(&line(&photos, &out, &learned_stub(root, &cases), ""), 0);
    assert!(stdout.contains("9 of 9 photographs"), "{stdout}");
    says(
        &stderr,
        &["built without ONNX", "going on with SIFT", "4 of 9 have a camera: matching again"],
    );
}

#[test]
fn an_archive_of_photographs_is_read_in_place() {
    let root = &Folder::empty();
    let (photos, out) = (photographed(root), root.join("scene"));
    let zip = root.join("photos.zip");
    pack(&photos, &zip, "scan/");
    model(9).write_binary(&root.join("models/0"));
    let colmap = stub(root, &models(root));
    let arguments = line(&zip, &out, &colmap, "");
    let (stdout, _) = run(&arguments, 0);
    assert!(stdout.contains("9 of 9 photographs"), "{stdout}");
    assert_eq!(load(&out).views.len(), 9);
}
