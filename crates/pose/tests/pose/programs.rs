//! COLMAP as it is called, its failures, and repeated runs of it.

use std::fs;
use std::path::PathBuf;

use nightsplat_photographs::image::{Image, ImageFile as _};
use nightsplat_pose::{Mapper, PoseFeatures, PoseOptions};

use crate::common::{Folder, says};
use crate::stub::{MODELS, SEEN, learned_stub, nothing_is_left, photographed, stub};
use crate::synthetic::{load, model, pack};
use crate::{finds_cameras, pose, refused};

/// One photograph in nine has no camera, so all are matched again.
#[test]
fn a_failed_second_matching_keeps_the_cameras_of_the_first() {
    let root = &Folder::empty();
    photographed(root);
    model(8).write_binary(&root.join("models/0"));
    let once = "[ -e $root/once ] && exit 9; touch $root/once; cp -r $root/models/* $output";
    stub(root, &format!("mapper) {once};;"));
    says(&finds_cameras(&pose(root), 8, 9), &["using the cameras found so far"]);
}

#[test]
fn cameras_are_registered_globally_by_colmap_or_else_by_glomap() {
    let root = &Folder::empty();
    photographed(root);
    model(8).write_binary(&root.join("models/0"));
    let globally = |out: &str, glomap: PathBuf| PoseOptions {
        mapper: Mapper::Global,
        glomap,
        out: root.join(out),
        ..pose(root)
    };
    let nowhere = || PathBuf::from("/nowhere/glomap");
    // COLMAP has this command from 4.0 on.
    stub(root, "help) echo global_mapper;;\nglobal_mapper) cp -r $root/models/* $output;;");
    finds_cameras(&globally("new", nowhere()), 8, 9);
    let log = root.text("new/colmap.log");
    let calibrated = log.find(" view_graph_calibrator --database_path").unwrap();
    assert!(log.find(" global_mapper --database_path").unwrap() > calibrated, "{log}");

    stub(root, MODELS);
    fs::rename(root.join("colmap-stub"), root.join("glomap")).unwrap();
    stub(root, "mapper) exit 9;;");
    finds_cameras(&globally("old", root.join("glomap")), 8, 9);
    assert_eq!(load(&root.join("old")).views.len(), 8);
    let lost = "global_mapper) echo 'failed to create sparse model'; exit 1;;";
    stub(root, &format!("help) echo global_mapper;;\n{lost}"));
    refused(&globally("none", nowhere()), 3, &["no cameras for these 9 photographs"]);
}

#[test]
fn a_failure_of_colmap_is_reported_in_a_line_and_leaves_no_dataset() {
    let root = &Folder::empty();
    photographed(root);
    model(2).write_binary(&root.join("models/0"));
    let pair = "mapper) echo 'E0 => No good initial image pair found'; exit 1;;";
    let fails = "feature_extractor) echo first; echo; echo no such camera >&2; exit 3;;";
    for (cases, parts) in [
        (fails, &["feature_extractor ended with", "3: no such camera"][..]),
        ("exhaustive_matcher) kill -9 $$;;", &["_matcher ended with signal: 9", "no output"]),
        (MODELS, &["no cameras for these 9 photographs", "scene.colmap.log"]),
        (pair, &["no cameras for these 9"]),
        ("mapper) echo broken; exit 1;;", &["mapper ended with", "broken"]),
    ] {
        stub(root, cases);
        refused(&pose(root), 3, parts);
        assert!(root.join("scene.colmap.log").is_file());
        nothing_is_left(root);
    }
}

#[test]
fn colmap_gets_the_focal_length_of_the_exif() {
    let root = &Folder::empty();
    let photos = root.join("photos");
    fs::create_dir_all(&photos).unwrap();
    // Orientation 6 and a focal length of 28 mm equivalent, big-endian as in some cameras.
    let exif = b"MM\0*\0\0\0\x08\0\x02\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\x87\x69\0\x04\0\0\0\x01\0\0\0\x26\0\0\0\0\
        \0\x01\xa4\x05\0\x03\0\0\0\x01\0\x1c\0\0\0\0\0\0";
    for index in 0..3 {
        let jpeg = fs::read(crate::common::fixture("jpeg/444.jpg")).unwrap();
        let length = (exif.len() as u16 + 8).to_be_bytes();
        let segment = [&[0xFF, 0xE1][..], &length, b"Exif\0\0", exif].concat();
        let turned = [&jpeg[..2], &segment, &jpeg[2..]].concat();
        fs::write(photos.join(format!("{index}.JPG")), turned).unwrap();
    }
    stub(root, SEEN);
    refused(&pose(root), 3, &["mapper ended with"]);
    for index in 0..3 {
        let seen = fs::read(root.join(format!("seen/{index}.JPG"))).unwrap();
        let focal = b"\xa4\x05\0\x03\0\0\0\x01\0\x1c";
        assert!(seen.windows(focal.len()).any(|bytes| bytes == focal));
        // The tone-mapped copy is in the stored orientation and marked as upright: cameras are those of the stored
        // photograph.
        let upright = b"\x01\x12\0\x03\0\0\0\x01\0\x01";
        assert!(seen.windows(upright.len()).any(|bytes| bytes == upright));
        assert_eq!(Image::size_of(root.join(format!("seen/{index}.JPG"))).unwrap(), (37, 29));
    }
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
    let told = finds_cameras(&pose(root), 9, 9);
    assert_eq!(told.matches("registering again, from a closer pair").count(), 2, "{told}");
    let relaxed = "--Mapper.init_max_forward_motion 1 --Mapper.init_min_num_inliers 50";
    says(&root.text("scene/colmap.log"), &[relaxed]);

    // The user's value is the only one.
    for_angle(3);
    let colmap_options = vec!["Mapper.init_min_tri_angle=3".to_owned()];
    finds_cameras(&PoseOptions { colmap_options, overwrite: true, ..pose(root) }, 9, 9);
    let log = root.text("scene/colmap.log");
    assert_eq!(log.matches("init_min_tri_angle").count(), 1, "{log}");
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
    let told = finds_cameras(&pose(root), 9, 9);
    let plan = "SIFT features; if most photographs have no camera, learned ones too";
    says(&told, &[plan, "4 of 9 have a camera: learned features, for at most 2 min"]);
    assert!(!told.contains("matching again"), "{told}");
    let log = root.text("scene/colmap.log");
    for option in
        ["--FeatureExtraction.type ALIKED_N16ROT", "--FeatureMatching.type ALIKED_LIGHTGLUE"]
    {
        assert_eq!(log.matches(option).count(), 1, "{option}: {log}");
    }

    // On request, they are the first and only ones.
    let asked = |features| PoseOptions { features: Some(features), overwrite: true, ..pose(root) };
    let told = finds_cameras(&asked(PoseFeatures::Learned), 9, 9);
    says(&told, &["learned features: ALIKED, matched by LightGlue"]);
    let log = root.text("scene/colmap.log");
    assert_eq!((log.matches("$ ").count(), log.matches("ALIKED_N16ROT").count()), (3, 1), "{log}");
    // With SIFT asked for, none are tried.
    let told = finds_cameras(&PoseOptions { patience: 0.1, ..asked(PoseFeatures::Sift) }, 4, 9);
    assert!(!told.contains("learned"), "{told}");
}

#[test]
fn a_colmap_without_learned_features_or_their_networks_is_told_with_the_remedy() {
    let root = &Folder::empty();
    photographed(root);
    let ask = PoseOptions { features: Some(PoseFeatures::Learned), ..pose(root) };
    let onnx = "ALIKED feature extraction requires ONNX support.";
    for (printed, parts) in [
        (onnx, ["built without ONNX", "--features sift"]),
        ("Check failed: Failed to download file", ["could not fetch", "n16rot_model_path=FILE"]),
    ] {
        learned_stub(root, &format!("feature_extractor) echo '{printed}' >&2; exit 1;;"));
        refused(&ask, 2, &parts);
    }
    // What is tried without being asked for is a warning, and SIFT goes on.
    model(4).write_binary(&root.join("some/0"));
    model(9).write_binary(&root.join("all/0"));
    learned_stub(
        root,
        "feature_extractor) case $database in */learned-*) echo 'requires ONNX support' >&2; exit 1;; esac;;\n\
         mapper) case $database in */guided.db) cp -r $root/all/* $output;; *) cp -r $root/some/* $output;; esac;;",
    );
    let told = finds_cameras(&pose(root), 9, 9);
    let parts =
        ["built without ONNX", "going on with SIFT", "4 of 9 have a camera: matching again"];
    says(&told, &parts);
}

#[test]
fn an_archive_of_photographs_is_read_in_place() {
    let root = &Folder::empty();
    pack(&photographed(root), &root.join("photos.zip"), "scan/");
    model(9).write_binary(&root.join("models/0"));
    stub(root, MODELS);
    finds_cameras(&PoseOptions { photos: root.join("photos.zip"), ..pose(root) }, 9, 9);
    assert_eq!(load(&root.join("scene")).views.len(), 9);
}
