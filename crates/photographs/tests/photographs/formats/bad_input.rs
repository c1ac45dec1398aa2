//! Bad input: one line that names the object, no panic, no huge allocation.

use super::*;

#[test]
fn a_missing_or_empty_folder_is_named() {
    let folder = Folder::empty();
    refuses(&folder.join("nowhere"), &["nowhere", "not a folder"]);
    refuses(&folder, &["no dataset", "transforms_train.json", "sparse/0"]);
}

#[test]
fn a_set_without_photographs_is_refused() {
    let folder = Folder::with_listing(4, |_| ());
    fs::remove_dir_all(folder.join("images")).unwrap();
    refuses(&folder, &["no photograph is left", "images/v00.png"]);
    write_json(folder.join("transforms.json"), &transforms(Vec::new()));
    refuses(&folder, &["no usable view"]);

    let folder = Folder::with_model(&model(9));
    fs::remove_dir_all(folder.join("images")).unwrap();
    refuses(&folder, &["no photograph is left"]);
}

#[test]
fn a_truncated_listing_is_named() {
    let folder = Folder::with_listing(2, |_| ());
    let path = folder.join("transforms.json");
    let text = fs::read(&path).unwrap();
    for length in 0..text.len() - 1 {
        fs::write(&path, &text[..length]).unwrap();
        refuses(&folder, &["transforms.json", "cut short"]);
    }
    fs::write(&path, "{\"frames\": 3}").unwrap();
    refuses(&folder, &["transforms.json", "not a usable transforms file"]);
    fs::write(&path, [0xFF, 0xFE, 0x00]).unwrap();
    refuses(&folder, &["transforms.json"]);
}

#[test]
fn frames_with_a_missing_file_are_counted_and_left_out() {
    let folder = Folder::lom();
    for (index, split) in [1, 2, 7].into_iter().flat_map(|index| [(index, "low"), (index, "high")])
    {
        fs::remove_file(folder.join(format!("{split}/{}.png", name(index)))).unwrap();
    }
    let dataset = load(&folder);
    assert_eq!(names(&dataset, Split::Train), ["v00", "v03", "v04", "v06", "v08", "v09"]);
    assert_eq!(names(&dataset, Split::Test), ["v02", "v05"]);
    assert!(view(&dataset, "v02").image.is_none() && view(&dataset, "v02").reference.is_none());
    assert_eq!(dataset.skipped.len(), 3, "{:?}", dataset.skipped);
}

#[test]
fn a_photograph_that_does_not_decode_is_named_and_the_others_are_used() {
    let folder = Folder::lom();
    let whole = fs::read(folder.join("low/v03.png")).unwrap();
    fs::write(folder.join("low/v03.png"), &whole[..whole.len() / 2]).unwrap();
    fs::write(folder.join("low/v04.png"), "no image at all").unwrap();
    fs::write(folder.join("high/v05.png"), "").unwrap();
    let dataset = load(&folder);
    assert_eq!(names(&dataset, Split::Train), ["v00", "v01", "v06", "v07", "v08", "v09"]);
    assert!(view(&dataset, "v05").image.is_some() && view(&dataset, "v05").reference.is_none());
    let skipped = dataset.skipped.join("\n");
    says(&skipped, &["low/v03.png", "low/v04.png", "high/v05.png"]);

    for index in 0..10 {
        fs::write(folder.join(format!("low/{}.png", name(index))), "no image").unwrap();
    }
    refuses(&folder, &["no photograph is left", "low/v00.png"]);
}

#[test]
fn two_views_with_one_name_are_refused() {
    let folder = Folder::lom();
    let frames = vec![frame(0, "low/v00.png"), frame(2, "low/v02.png")];
    write_json(folder.join("transforms_train.json"), &transforms(frames));
    refuses(&folder, &["two views are named v02", "high/v02.png", "low/v02.png", "rename"]);

    let mut model = model(9);
    model.images[3].3 = "v00.png".into();
    let folder = Folder::with_model(&model);
    refuses(&folder, &["two views are named v00"]);
}

#[test]
fn an_unsupported_camera_model_is_named() {
    for (name, number, count, remedy) in [
        ("FOV", 7, 5, "image_undistorter"),
        ("THIN_PRISM_FISHEYE", 10, 12, "image_undistorter"),
        ("RAD_TAN_THIN_PRISM_FISHEYE", 11, 16, "image_undistorter"),
        ("SIMPLE_DIVISION", 12, 4, "image_undistorter"),
        ("DIVISION", 13, 5, "image_undistorter"),
        ("EUCM", 16, 6, "image_undistorter"),
        ("EQUIRECTANGULAR", 17, 2, "faces of a cube"),
    ] {
        let written = Model { cameras: vec![(3, name, number, vec![20.0; count])], ..model(9) };
        for folder in Folder::with_either_model(&written) {
            refuses(&folder, &["camera 3", name, remedy]);
        }
    }
    let cameras = vec![(3, "?", 99, vec![20.0; 4])];
    let folder = Folder::with_model(&Model { cameras, ..model(9) });
    refuses(&folder, &["cameras.bin", "unknown model 99"]);

    for (settings, parts) in [
        (json!({"camera_model": "FOV"}), ["not supported", "image_undistorter"]),
        (json!({"is_fisheye": true, "p1": 0.1}), ["not supported", "image_undistorter"]),
        (json!({"k4": 0.1}), ["not supported", "image_undistorter"]),
        (json!({"camera_model": "EQUIRECTANGULAR"}), ["EQUIRECTANGULAR", "faces of a cube"]),
    ] {
        let parts = [&["transforms.json"][..], &parts].concat();
        refuses_listing(|listing| extend(listing, &settings), &parts);
    }
}

#[test]
fn a_truncated_model_is_named_and_a_corrupt_count_allocates_nothing() {
    let mut small = model(2);
    small.points.truncate(2);
    let folder = Folder::with_model(&small);
    load(&folder);
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        let path = folder.join("sparse/0").join(file);
        let whole = fs::read(&path).unwrap();
        for length in 0..whole.len() {
            fs::write(&path, &whole[..length]).unwrap();
            refuses(&folder, &[file, "cut short"]);
        }
        let mut corrupt = whole.clone();
        corrupt[..8].fill(0xFF);
        fs::write(&path, &corrupt).unwrap();
        refuses(&folder, &[file]);
        fs::write(&path, &whole).unwrap();
    }
    // Also the number of keypoints and the length of a track.
    let keypoints = 8 + 64 + "v01.png".len() + 1;
    for (file, at, part) in [
        ("images.bin", keypoints, "cut short at image 1 of 2"),
        ("points3D.bin", 8 + 43, "cut short at point 1 of 2"),
    ] {
        small.write_binary(&folder.join("sparse/0"));
        let path = folder.join("sparse/0").join(file);
        let mut corrupt = fs::read(&path).unwrap();
        corrupt[at..at + 8].fill(0xFF);
        fs::write(&path, &corrupt).unwrap();
        refuses(&folder, &[file, part]);
    }
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
        let folder = Folder::with_text_model(&model(9));
        let text = format!("# comment\n{line}\n");
        fs::write(folder.join("sparse/0").join(file), text).unwrap();
        refuses(&folder, &[file, part]);
    }
}

#[test]
fn an_image_of_an_unlisted_camera_is_named() {
    let mut model = model(9);
    model.images[0].2 = 55;
    let folder = Folder::with_model(&model);
    refuses(&folder, &["v08.png", "camera 55"]);
}

#[test]
fn an_invalid_pose_is_named_and_left_out() {
    let folder = Folder::with_listing(10, |json| {
        json["frames"][3]["transform_matrix"][0][3] = json!("HERE");
        json["frames"][5]["transform_matrix"][1][1] = json!(7.0);
        json["frames"][6]["transform_matrix"] = json!([[1.0], [0.0]]);
    });
    // In Python's notation.
    let path = folder.join("transforms.json");
    let text = fs::read_to_string(&path).unwrap().replace("\"HERE\"", "-Infinity");
    let unused = "\"cx\": 18.0, \"note\": \"NaN\", \"unused\": NaN";
    fs::write(&path, text.replacen("\"cx\": 18.0", unused, 1)).unwrap();
    let dataset = load(&folder);
    assert_eq!(dataset.views.len(), 7);
    let skipped = dataset.skipped.join("\n");
    says(&skipped, &["v03", "v05", "v06"]);

    let mut model = model(9);
    model.images[0].1.translation = DVec3::NAN;
    model.points[2].1.y = f64::NAN;
    let folder = Folder::with_model(&model);
    let dataset = load(&folder);
    assert_eq!((dataset.views.len(), dataset.points.len()), (8, 19));
    assert!(dataset.skipped[0].contains("v08.png"), "{:?}", dataset.skipped);

    model.images.iter_mut().for_each(|(_, pose, ..)| pose.translation = DVec3::INFINITY);
    let folder = Folder::with_model(&model);
    refuses(&folder, &["no usable view", "v08.png: its pose is not finite"]);
}

#[test]
fn an_invalid_focal_length_is_not_a_missing_one() {
    for key in ["fl_x", "cx", "k1"] {
        let folder = Folder::with_listing(4, |json| {
            json["camera_angle_x"] = json!(0.9);
            json[key] = json!("HERE");
        });
        let path = folder.join("transforms.json");
        let text = fs::read_to_string(&path).unwrap().replace("\"HERE\"", "NaN");
        fs::write(&path, text).unwrap();
        refuses(&folder, &["v00", "mend the intrinsics"]);
    }
}

#[test]
fn a_photograph_with_another_size_than_its_camera_is_refused() {
    let folder = Folder::with_listing(4, |_| ());
    photograph(&folder.join("images/v02.png"), (30, 40), 0.1);
    refuses(&folder, &["v02.png", "30x40", "40x30"]);

    let folder = Folder::lom();
    photograph(&folder.join("high/v05.png"), (40, 40), 0.1);
    refuses(&folder, &["high/v05.png", "40x40", "40x30"]);
}

#[test]
fn invalid_intrinsics_are_refused() {
    for (key, value) in
        [("fl_x", json!(-3.0)), ("w", json!(0.0)), ("h", json!(1e12)), ("k1", json!(-90.0))]
    {
        refuses_listing(|json| json[key] = value, &["v00"]);
    }
    let without_focal = |json: &mut Value| drop(json.as_object_mut().unwrap().remove("fl_x"));
    refuses_listing(without_focal, &["v00", "neither fl_x nor camera_angle_x"]);
    let cameras = vec![(3, "PINHOLE", 1, vec![f64::NAN; 4])];
    let folder = Folder::with_model(&Model { cameras, ..model(9) });
    refuses(&folder, &["cameras.bin", "camera 3", "focal length"]);
}

#[test]
fn a_photograph_of_one_pixel_is_named_rather_than_an_option() {
    let folder = Folder::with_listing(3, |all| (all["w"], all["h"]) = (json!(1), json!(1)));
    photographs_of_size(&folder, "images", 0..3, (1, 1), 1.0);
    refuses(&folder, &["view v00: is of 1x1 pixels", "at least 16"]);
}

#[test]
fn a_downscale_that_leaves_no_image_is_misuse() {
    let folder = Folder::with_listing(3, |_| ());
    for downscale in [0.0, -2.0, f64::NAN, f64::INFINITY, 0.5] {
        let options = LoadOptions { downscale, ..Default::default() };
        refuses_with(&folder, &options, 2, &["downscale"]);
    }
    let options = LoadOptions { downscale: 2.0, ..Default::default() };
    refuses_with(&folder, &options, 2, &["20x15", "at least 16"]);
    let reference = Some(folder.join("nowhere"));
    let options = LoadOptions { reference, ..Default::default() };
    refuses_with(&folder, &options, 3, &["nowhere"]);
}
