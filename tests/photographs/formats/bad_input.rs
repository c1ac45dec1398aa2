//! Bad input: one line that names the object, no panic, no huge allocation.

use std::fs;
use std::path::Path;

use glam::DVec3;
use nightsplat::photographs::dataset::{Dataset, LoadOptions, Split};
use serde_json::json;

use super::synthetic::*;
use super::{load, names, view};

/// The one-line error of loading `root`, which must contain all of `parts`.
fn refused(root: &Path, parts: &[&str]) {
    refused_with(root, &LoadOptions::default(), 3, parts);
}

fn refused_with(root: &Path, options: &LoadOptions, exit_code: u8, parts: &[&str]) {
    let error = Dataset::load(root, options).expect_err("this should be refused");
    let message = error.to_string();
    assert_eq!(error.exit_code(), exit_code, "{message}");
    assert!(!message.contains('\n'), "more than a line: {message}");
    for part in parts {
        assert!(message.contains(part), "no `{part}` in: {message}");
    }
}

fn single(root: &Path, views: usize) {
    photographs(root, "images", 0..views, 1.0);
    let frames =
        (0..views).map(|index| frame(index, &format!("images/{}.png", name(index)))).collect();
    write_json(root.join("transforms.json"), &transforms(frames));
}

fn edit_json(path: &Path, edit: impl FnOnce(&mut serde_json::Value)) {
    let mut value = serde_json::from_slice(&fs::read(path).unwrap()).unwrap();
    edit(&mut value);
    write_json(path, &value);
}

fn colmap(root: &Path, model: &Model) {
    photographs(root, "images", 0..9, 1.0);
    model.write_binary(&root.join("sparse/0"));
}

#[test]
fn a_missing_or_empty_folder_is_named() {
    let folder = tempfile::tempdir().unwrap();
    refused(&folder.path().join("nowhere"), &["nowhere", "not a folder"]);
    refused(folder.path(), &["no dataset", "transforms_train.json", "sparse/0"]);
}

#[test]
fn a_set_without_photographs_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    single(folder.path(), 4);
    fs::remove_dir_all(folder.path().join("images")).unwrap();
    refused(folder.path(), &["no photograph is left", "images/v00.png"]);
    write_json(folder.path().join("transforms.json"), &transforms(Vec::new()));
    refused(folder.path(), &["no usable view"]);

    let folder = tempfile::tempdir().unwrap();
    model(9).write_binary(&folder.path().join("sparse/0"));
    refused(folder.path(), &["no photograph is left"]);
}

#[test]
fn a_truncated_listing_is_named() {
    let folder = tempfile::tempdir().unwrap();
    single(folder.path(), 2);
    let path = folder.path().join("transforms.json");
    let text = fs::read(&path).unwrap();
    for length in 0..text.len() - 1 {
        fs::write(&path, &text[..length]).unwrap();
        refused(folder.path(), &["transforms.json", "cut short"]);
    }
    fs::write(&path, "{\"frames\": 3}").unwrap();
    refused(folder.path(), &["transforms.json", "not a usable transforms file"]);
    fs::write(&path, [0xFF, 0xFE, 0x00]).unwrap();
    refused(folder.path(), &["transforms.json"]);
}

#[test]
fn frames_with_a_missing_file_are_counted_and_left_out() {
    let folder = tempfile::tempdir().unwrap();
    lom(folder.path(), 10, &[2, 5]);
    for index in [1, 2, 7] {
        for directory in ["low", "high"] {
            fs::remove_file(folder.path().join(directory).join(name(index)).with_extension("png"))
                .unwrap();
        }
    }
    let dataset = load(folder.path());
    assert_eq!(names(&dataset, Split::Train), ["v00", "v03", "v04", "v06", "v08", "v09"]);
    assert_eq!(names(&dataset, Split::Test), ["v02", "v05"]);
    assert!(view(&dataset, "v02").image.is_none() && view(&dataset, "v02").reference.is_none());
    assert_eq!(dataset.skipped.len(), 3, "{:?}", dataset.skipped);
}

#[test]
fn a_photograph_that_does_not_decode_is_named_and_the_others_are_used() {
    let folder = tempfile::tempdir().unwrap();
    lom(folder.path(), 10, &[2, 5]);
    let whole = fs::read(folder.path().join("low/v03.png")).unwrap();
    fs::write(folder.path().join("low/v03.png"), &whole[..whole.len() / 2]).unwrap();
    fs::write(folder.path().join("low/v04.png"), "no image at all").unwrap();
    fs::write(folder.path().join("high/v05.png"), "").unwrap();
    let dataset = load(folder.path());
    assert_eq!(names(&dataset, Split::Train), ["v00", "v01", "v06", "v07", "v08", "v09"]);
    assert!(view(&dataset, "v05").image.is_some() && view(&dataset, "v05").reference.is_none());
    let skipped = dataset.skipped.join("\n");
    assert!(
        ["low/v03.png", "low/v04.png", "high/v05.png"].iter().all(|name| skipped.contains(name)),
        "{skipped}"
    );

    for index in 0..10 {
        fs::write(folder.path().join("low").join(name(index)).with_extension("png"), "no image")
            .unwrap();
    }
    refused(folder.path(), &["no photograph is left", "low/v00.png"]);
}

#[test]
fn two_views_with_one_name_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    lom(folder.path(), 10, &[2, 5]);
    let train = folder.path().join("transforms_train.json");
    edit_json(&train, |json| json["frames"].as_array_mut().unwrap().push(frame(2, "low/v02.png")));
    refused(folder.path(), &["two views are named v02", "high/v02.png", "low/v02.png", "rename"]);

    let folder = tempfile::tempdir().unwrap();
    let mut model = model(9);
    model.images[3].3 = "v00.png".into();
    colmap(folder.path(), &model);
    refused(folder.path(), &["two views are named v00"]);
}

#[test]
fn an_unsupported_camera_model_is_named() {
    for (model_name, number, parameters) in
        [("FOV", 7, 5), ("THIN_PRISM_FISHEYE", 10, 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 11, 16)]
    {
        let folder = tempfile::tempdir().unwrap();
        let cameras = vec![(3, model_name, number, vec![20.0; parameters])];
        colmap(folder.path(), &Model { cameras, ..model(9) });
        refused(folder.path(), &["camera 3", model_name, "image_undistorter"]);
        let folder = tempfile::tempdir().unwrap();
        let cameras = vec![(3, model_name, number, vec![20.0; parameters])];
        Model { cameras, ..model(9) }.write_text(&folder.path().join("sparse/0"));
        refused(folder.path(), &["camera 3", model_name, "image_undistorter"]);
    }
    let folder = tempfile::tempdir().unwrap();
    colmap(folder.path(), &Model { cameras: vec![(3, "?", 99, vec![20.0; 4])], ..model(9) });
    refused(folder.path(), &["cameras.bin", "unknown model 99"]);

    let unsupported = [
        json!({"camera_model": "FOV"}),
        json!({"is_fisheye": true, "p1": 0.1}),
        json!({"k4": 0.1}),
    ];
    for settings in unsupported {
        let folder = tempfile::tempdir().unwrap();
        single(folder.path(), 3);
        edit_json(&folder.path().join("transforms.json"), |json| {
            for (key, value) in settings.as_object().unwrap() {
                json[key] = value.clone();
            }
        });
        refused(folder.path(), &["transforms.json", "not supported", "image_undistorter"]);
    }
}

#[test]
fn a_truncated_model_is_named_and_a_corrupt_count_allocates_nothing() {
    let folder = tempfile::tempdir().unwrap();
    photographs(folder.path(), "images", 0..2, 1.0);
    let mut small = model(2);
    small.points.truncate(2);
    small.write_binary(&folder.path().join("sparse/0"));
    load(folder.path());
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        let path = folder.path().join("sparse/0").join(file);
        let whole = fs::read(&path).unwrap();
        for length in 0..whole.len() {
            fs::write(&path, &whole[..length]).unwrap();
            refused(folder.path(), &[file, "cut short"]);
        }
        let mut corrupt = whole.clone();
        corrupt[..8].fill(0xFF);
        fs::write(&path, &corrupt).unwrap();
        refused(folder.path(), &[file]);
        fs::write(&path, &whole).unwrap();
    }
    // Also the number of keypoints and the length of a track.
    let images = folder.path().join("sparse/0/images.bin");
    let mut corrupt = fs::read(&images).unwrap();
    let keypoints = 8 + 64 + "v01.png".len() + 1;
    corrupt[keypoints..keypoints + 8].fill(0xFF);
    fs::write(&images, &corrupt).unwrap();
    refused(folder.path(), &["images.bin", "cut short at image 1 of 2"]);
    small.write_binary(&folder.path().join("sparse/0"));
    let points = folder.path().join("sparse/0/points3D.bin");
    let mut corrupt = fs::read(&points).unwrap();
    corrupt[8 + 43..8 + 51].fill(0xFF);
    fs::write(&points, &corrupt).unwrap();
    refused(folder.path(), &["points3D.bin", "cut short at point 1 of 2"]);
}

#[test]
fn a_text_model_with_a_broken_line_names_the_line() {
    for (file, line, part) in [
        ("cameras.txt", "3 PINHOLE forty 30 1 1 1 1", "width"),
        ("cameras.txt", "3 PINHOLE 40 30 1 1 1", "parameters"),
        ("images.txt", "7 1 0 0", "pose"),
        ("images.txt", "7 1 0 0 0 0 0 0 3", "name"),
        ("points3D.txt", "7 1 0", "z"),
        ("points3D.txt", "7 1 0 0 1 1 1 0.5 7", "keypoint"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        photographs(folder.path(), "images", 0..9, 1.0);
        model(9).write_text(&folder.path().join("sparse/0"));
        fs::write(folder.path().join("sparse/0").join(file), format!("# comment\n{line}\n"))
            .unwrap();
        refused(folder.path(), &[file, part]);
    }
}

#[test]
fn an_image_of_an_unlisted_camera_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut model = model(9);
    model.images[0].2 = 55;
    colmap(folder.path(), &model);
    refused(folder.path(), &["v08.png", "camera 55"]);
}

#[test]
fn an_invalid_pose_is_named_and_left_out() {
    let folder = tempfile::tempdir().unwrap();
    single(folder.path(), 10);
    let path = folder.path().join("transforms.json");
    edit_json(&path, |json| {
        json["frames"][3]["transform_matrix"][0][3] = json!("HERE");
        json["frames"][5]["transform_matrix"][1][1] = json!(7.0);
        json["frames"][6]["transform_matrix"] = json!([[1.0], [0.0]]);
    });
    // In Python's notation.
    let text = fs::read_to_string(&path).unwrap().replace("\"HERE\"", "-Infinity");
    fs::write(
        &path,
        text.replacen("\"cx\": 18.0", "\"cx\": 18.0, \"note\": \"NaN\", \"unused\": NaN", 1),
    )
    .unwrap();
    let dataset = load(folder.path());
    assert_eq!(dataset.views.len(), 7);
    let skipped = dataset.skipped.join("\n");
    assert!(["v03", "v05", "v06"].iter().all(|name| skipped.contains(name)), "{skipped}");

    let folder = tempfile::tempdir().unwrap();
    let mut model = model(9);
    model.images[0].1.translation = DVec3::NAN;
    model.points[2].1.y = f64::NAN;
    colmap(folder.path(), &model);
    let dataset = load(folder.path());
    assert_eq!((dataset.views.len(), dataset.points.len()), (8, 19));
    assert!(dataset.skipped[0].contains("v08.png"), "{:?}", dataset.skipped);

    model.images.iter_mut().for_each(|(_, pose, ..)| pose.translation = DVec3::INFINITY);
    colmap(folder.path(), &model);
    refused(folder.path(), &["no usable view", "v08.png: its pose is not finite"]);
}

#[test]
fn an_invalid_focal_length_is_not_a_missing_one() {
    for key in ["fl_x", "cx", "k1"] {
        let folder = tempfile::tempdir().unwrap();
        single(folder.path(), 4);
        let path = folder.path().join("transforms.json");
        edit_json(&path, |json| {
            json["camera_angle_x"] = json!(0.9);
            json[key] = json!("HERE");
        });
        let text = fs::read_to_string(&path).unwrap().replace("\"HERE\"", "NaN");
        fs::write(&path, text).unwrap();
        refused(folder.path(), &["v00", "mend the intrinsics"]);
    }
}

#[test]
fn a_photograph_with_another_size_than_its_camera_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    single(folder.path(), 4);
    photograph(&folder.path().join("images/v02.png"), (30, 40), 0.1);
    refused(folder.path(), &["v02.png", "30x40", "40x30"]);

    let folder = tempfile::tempdir().unwrap();
    lom(folder.path(), 10, &[2, 5]);
    photograph(&folder.path().join("high/v05.png"), (40, 40), 0.1);
    refused(folder.path(), &["high/v05.png", "40x40", "40x30"]);
}

#[test]
fn invalid_intrinsics_are_refused() {
    for (key, value) in
        [("fl_x", json!(-3.0)), ("w", json!(0.0)), ("h", json!(1e12)), ("k1", json!(-90.0))]
    {
        let folder = tempfile::tempdir().unwrap();
        single(folder.path(), 3);
        edit_json(&folder.path().join("transforms.json"), |json| json[key] = value);
        refused(folder.path(), &["v00"]);
    }
    let folder = tempfile::tempdir().unwrap();
    single(folder.path(), 3);
    edit_json(&folder.path().join("transforms.json"), |json| {
        json.as_object_mut().unwrap().remove("fl_x");
    });
    refused(folder.path(), &["v00", "neither fl_x nor camera_angle_x"]);
    let folder = tempfile::tempdir().unwrap();
    colmap(
        folder.path(),
        &Model { cameras: vec![(3, "PINHOLE", 1, vec![f64::NAN; 4])], ..model(9) },
    );
    refused(folder.path(), &["cameras.bin", "camera 3", "focal length"]);
}

#[test]
fn a_photograph_of_one_pixel_is_named_rather_than_an_option() {
    let folder = tempfile::tempdir().unwrap();
    single(folder.path(), 3);
    for index in 0..3 {
        photograph(&folder.path().join(format!("images/{}.png", name(index))), (1, 1), 0.2);
    }
    edit_json(&folder.path().join("transforms.json"), |all| {
        (all["w"], all["h"]) = (json!(1), json!(1));
    });
    refused(folder.path(), &["view v00: is of 1x1 pixels", "at least 16"]);
}

#[test]
fn a_downscale_that_leaves_no_image_is_misuse() {
    let folder = tempfile::tempdir().unwrap();
    single(folder.path(), 3);
    for downscale in [0.0, -2.0, f64::NAN, f64::INFINITY, 0.5] {
        let options = LoadOptions { downscale, ..LoadOptions::default() };
        refused_with(folder.path(), &options, 2, &["downscale"]);
    }
    let options = LoadOptions { downscale: 2.0, ..LoadOptions::default() };
    refused_with(folder.path(), &options, 2, &["20x15", "at least 16"]);
    let reference = Some(folder.path().join("nowhere"));
    refused_with(
        folder.path(),
        &LoadOptions { reference, ..LoadOptions::default() },
        3,
        &["nowhere"],
    );
}
