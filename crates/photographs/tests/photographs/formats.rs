//! Datasets: every layout is recognised and read equally, and bad input is refused in one line.

mod as_it_is;
mod bad_input;
mod colours;
mod keys;
mod layouts;
mod levels;
mod models;
mod photographs;
#[cfg(feature = "raw")]
mod raw;
mod real;
pub(crate) mod synthetic;
mod turned;

use std::fs;
use std::path::Path;

use glam::{DAffine3, DMat3, DQuat, DVec2, DVec3};
use image::{ImageBuffer, Luma, Rgb, Rgba};
use nightsplat_core::camera::{CameraModel, KannalaBrandt};
use nightsplat_photographs::dataset::{Dataset, LoadOptions, Split, View};
use nightsplat_photographs::image::{Image, ImageFile, Mask, Orientation};
use serde_json::{Value, json};

use crate::common::{Folder, paths, says};
use crate::log::warnings;
use synthetic::*;

/// The dataset of a listing must be refused.
fn refuses_listing(edit: impl FnOnce(&mut Value), parts: &[&str]) {
    refuses(&Folder::with_listing(9, edit), parts);
}

/// The dataset must be refused in one line that contains all of `parts`.
fn refuses(root: &Path, parts: &[&str]) {
    refuses_with(root, &LoadOptions::default(), 3, parts);
}

fn refuses_with(root: &Path, options: &LoadOptions, exit_code: u8, parts: &[&str]) {
    let error = Dataset::load(root, options).expect_err("this should be refused");
    let message = error.to_string();
    assert_eq!(error.exit_code(), exit_code, "{message}");
    assert!(!message.contains('\n'), "more than a line: {message}");
    says(&message, parts);
}

/// The image's one value in units of 1/255, or `None` without an image.
fn level(image: Option<&Image>) -> Option<f32> {
    let image = image?;
    assert!(image.data.iter().all(|value| (value - image.data[0]).abs() < 1e-6), "not one colour");
    Some((image.data[0] * 255.0).round())
}

fn assert_camera_is_view(view: &View, index: usize) {
    let (camera, pose) = (view.camera, pose(index));
    assert!(
        camera.view_from_world.abs_diff_eq(pose, 1e-9),
        "{}: {:?}",
        view.name,
        camera.view_from_world
    );
    assert_eq!((camera.width, camera.height), SIZE);
    assert!(
        camera.focal.abs_diff_eq(FOCAL, 1e-9)
            && camera.principal_point.abs_diff_eq(PRINCIPAL_POINT, 1e-9)
    );
}

#[test]
fn the_lom_layout_trains_on_low_and_scores_against_high() {
    let folder = Folder::lom();
    let dataset = load(&folder);
    assert_eq!(dataset.views.len(), 10);
    assert_eq!(names(&dataset, Split::Test), ["v02", "v05"]);
    for (index, view) in dataset.views.iter().enumerate() {
        assert_camera_is_view(view, index);
        assert_eq!(level(view.image.as_ref()), Some(10.0 + index as f32));
        let reference = (view.split == Split::Test).then_some(4.0 * (10.0 + index as f32));
        assert_eq!(level(view.reference.as_ref()), reference);
    }
    assert!(dataset.points.is_empty() && dataset.skipped.is_empty(), "{:?}", dataset.skipped);

    let dataset = load_with(&folder, LoadOptions { load_low_test: false, ..Default::default() });
    assert!(dataset.test_views().all(|view| view.image.is_none() && view.reference.is_some()));
}

#[test]
fn a_validation_listing_replaces_a_missing_test_listing() {
    let folder = Folder::lom();
    fs::remove_file(folder.join("transforms_test.json")).unwrap();
    assert_eq!(names(&load(&folder), Split::Test), ["v02"]);
}

#[test]
fn the_realx3d_layout_keeps_test_poses_without_photographs_and_finds_files_without_extension() {
    let root = &Folder::empty();
    photographs(root, "train", 0..4, 1.0);
    write_json(root.join("transforms_train.json"), &listed("train", 0..4, ""));
    write_json(root.join("transforms_test.json"), &listed("test", 4..6, ""));
    let dataset = load(root);
    assert_eq!(names(&dataset, Split::Train), ["v00", "v01", "v02", "v03"]);
    assert_eq!(level(view(&dataset, "v03").image.as_ref()), Some(13.0));
    assert_eq!(names(&dataset, Split::Test), ["v04", "v05"]);
    assert!(dataset.test_views().all(|view| view.image.is_none() && view.reference.is_none()));
    assert_camera_is_view(view(&dataset, "v05"), 5);
    assert_eq!(dataset.skipped.len(), 2);

    // If they exist, they are scored against, not trained on.
    photographs(root, "test", 4..6, 4.0);
    let dataset = load(root);
    assert_eq!(level(view(&dataset, "v04").reference.as_ref()), Some(56.0));
    assert_eq!(level(view(&dataset, "v04").image.as_ref()), None);
}

#[test]
fn in_a_single_listing_every_eighth_view_by_name_is_a_test_view() {
    let reverse = |listing: &mut Value| listing["frames"].as_array_mut().unwrap().reverse();
    let dataset = load(&Folder::with_listing(18, reverse));
    assert_eq!(names(&dataset, Split::Test), ["v00", "v08", "v16"]);
    assert!(dataset.views.iter().all(|view| view.image.is_some() && view.reference.is_none()));
}

#[test]
fn a_frames_own_intrinsics_override_and_views_may_differ_in_size() {
    let intrinsics = json!({ "w": 64, "h": 50.0, "camera_angle_x": 1.0, "cx": 30.0 });
    let folder = Folder::with_listing(4, |listing| extend(&mut listing["frames"][1], &intrinsics));
    photograph(&folder.join("images/v01.png"), (64, 50), 0.1);
    let dataset = load(&folder);
    let camera = view(&dataset, "v01").camera;
    assert_eq!((camera.width, camera.height), (64, 50));
    assert!(camera.focal.abs_diff_eq(DVec2::splat(32.0 / 0.5_f64.tan()), 1e-9), "{}", camera.focal);
    assert_eq!(camera.principal_point, DVec2::new(30.0, 16.0));
    assert_camera_is_view(view(&dataset, "v02"), 2);
}

#[test]
fn an_angle_of_view_gives_a_centred_camera_of_the_photographs_size() {
    let folder = Folder::with_listing(3, |listing| {
        *listing = json!({ "camera_angle_x": 0.8, "frames": listing["frames"] });
    });
    let camera = load(&folder).views[1].camera;
    assert_eq!((camera.width, camera.height), SIZE);
    assert!(camera.focal.abs_diff_eq(DVec2::splat(20.0 / 0.4_f64.tan()), 1e-9));
    assert_eq!(camera.principal_point, DVec2::new(20.0, 15.0));
}

#[test]
fn backslashes_and_frames_of_unknown_size_are_handled() {
    let path = |index: usize| format!(".\\images\\{}.png", name(index));
    let frames: Vec<_> = (0..4).map(|index| frame(index, &path(index))).collect();
    let folder = Folder::with_listing(3, |listing| {
        *listing = json!({ "fl_x": 35.0, "frames": frames });
    });
    let dataset = load(&folder);
    assert_eq!(dataset.views.len(), 3);
    assert!(
        dataset.skipped[0].contains("images/v03.png: neither w and h"),
        "{:?}",
        dataset.skipped
    );
}

#[test]
fn a_model_without_points_loads_without_points() {
    let folder = Folder::with_model(&model(9));
    fs::remove_file(folder.join("sparse/0/points3D.bin")).unwrap();
    let dataset = load(&folder);
    assert_eq!((dataset.views.len(), dataset.points.len()), (9, 0));
}

#[test]
fn both_colmap_encodings_and_folders_give_the_same_dataset() {
    let [binary, text] = Folder::with_either_model(&model(10)).map(|root| load(&root));
    let moved = Folder::with_either_model(&model(10)).map(|root| {
        for file in paths(&root.join("sparse/0")) {
            fs::rename(&file, root.join("sparse").join(file.file_name().unwrap())).unwrap();
        }
        load(&root)
    });
    assert_eq!(names(&binary, Split::Test), ["v00", "v08"]);
    for (index, view) in binary.views.iter().enumerate() {
        assert_camera_is_view(view, index);
        assert_eq!(level(view.image.as_ref()), Some(10.0 + index as f32));
    }
    assert_eq!(binary.points.len(), 20);
    assert_eq!(
        binary.points[1].position,
        DVec3::new(1.0_f64.cos(), 1.0_f64.sin(), 0.2 * 3.0_f64.sin())
    );
    assert_eq!(binary.points[1].views, [2, 5, 8]);
    for other in [text].into_iter().chain(moved) {
        assert_eq!(other.points, binary.points);
        let cameras =
            |dataset: &Dataset| dataset.views.iter().map(|view| view.camera).collect::<Vec<_>>();
        assert_eq!(cameras(&other), cameras(&binary));
    }
}

#[test]
fn every_supported_camera_model_is_read_and_undistorted() {
    let (f, cx, cy) = (35.0, 18.0, 16.0);
    let models: [(&str, u32, &[f64]); 5] = [
        ("SIMPLE_PINHOLE", 0, &[f, cx, cy]),
        ("PINHOLE", 1, &[f, f, cx, cy]),
        ("SIMPLE_RADIAL", 2, &[f, cx, cy, 0.1]),
        ("RADIAL", 3, &[f, cx, cy, 0.1, -0.02]),
        ("OPENCV", 4, &[f, f, cx, cy, 0.1, -0.02, 0.001, 0.002]),
    ];
    for (name, number, parameters) in models {
        let cameras = vec![(3, name, number, parameters.to_vec())];
        let folder = Folder::with_model(&Model { cameras, ..model(3) });
        let camera = load(&folder).views[0].camera;
        assert_eq!(camera.principal_point, DVec2::new(cx, cy), "{name}");
        let distorted = number >= 2;
        // The zoom that leaves no blank pixel is the same factor for both axes.
        assert_eq!((camera.focal.x - f).abs() > 0.1, distorted, "{name}: {}", camera.focal);
        assert!((camera.focal.x - camera.focal.y).abs() < 1e-9, "{name}");
    }
}

#[test]
fn photographs_and_references_are_undistorted_equally() {
    let root = &Folder::empty();
    let pattern = |gain: f32| {
        move |x: u32, y: u32| {
            [(x as f32 / 40.0) * gain, (y as f32 / 30.0) * gain, ((x * y) % 7) as f32 / 7.0 * gain]
        }
    };
    for (directory, gain) in [("low", 0.25), ("images", 1.0)] {
        fs::create_dir(root.join(directory)).unwrap();
        for index in 0..9 {
            let path = root.join(directory).join(name(index)).with_extension("exr");
            Image::from_fn(SIZE.0, SIZE.1, pattern(gain)).save_exr(path).unwrap();
        }
    }
    let cameras = vec![(3, "OPENCV", 4, vec![35.0, 36.0, 18.0, 16.0, -0.2, 0.03, 0.002, -0.001])];
    Model { cameras, ..model(9) }.write_text(&root.join("sparse/0"));
    let dataset = load(root);
    let view = &dataset.views[0];
    let (low, reference) = (view.image.as_ref().unwrap(), view.reference.as_ref().unwrap());
    let worst = low
        .data
        .iter()
        .zip(&reference.data)
        .map(|(low, high)| (4.0 * low - high).abs())
        .fold(0.0, f32::max);
    assert!(worst < 1e-5, "{worst}");
    let original = Image::from_fn(SIZE.0, SIZE.1, pattern(1.0));
    assert!(
        reference.data.iter().zip(&original.data).any(|(a, b)| (a - b).abs() > 0.05),
        "nothing was undistorted"
    );
}

#[test]
fn low_folders_are_the_input_and_normal_light_folders_the_reference() {
    for (dark_folder, normal) in
        [("low", "images"), ("images_low", "images"), ("low", "high"), ("low", "val")]
    {
        let folder = Folder::empty();
        photographs(&folder, dark_folder, 0..9, 1.0);
        photographs(&folder, normal, 0..9, 4.0);
        model(9).write_binary(&folder.join("sparse/0"));
        let dataset = load(&folder);
        assert_eq!(dataset.views.len(), 9);
        for (index, view) in dataset.views.iter().enumerate() {
            assert_eq!(
                level(view.image.as_ref()),
                Some(10.0 + index as f32),
                "{dark_folder}, {normal}"
            );
            let reference = (view.split == Split::Test).then_some(40.0 + 4.0 * index as f32);
            assert_eq!(level(view.reference.as_ref()), reference, "{dark_folder}, {normal}");
        }
    }
}

#[test]
fn a_list_of_test_names_decides_the_split() {
    let folder = Folder::with_model(&model(9));
    fs::write(folder.join("test.txt"), "v03.png\n\n v05 \r\nunknown.png\n").unwrap();
    assert_eq!(names(&load(&folder), Split::Test), ["v03", "v05"]);
    fs::rename(folder.join("test.txt"), folder.join("sparse/0/test.txt")).unwrap();
    assert_eq!(names(&load(&folder), Split::Test), ["v03", "v05"]);
}

#[test]
fn a_given_reference_folder_overrides_and_may_have_another_resolution() {
    let folder = Folder::empty();
    let root = folder.join("set");
    lom(&root, 10, &[2, 5]);
    photograph(&folder.join("mine/v05.png"), (2 * SIZE.0, 2 * SIZE.1), 0.8);
    let reference = Some(folder.join("mine"));
    let dataset = load_with(&root, LoadOptions { reference, ..Default::default() });
    assert_eq!(level(view(&dataset, "v05").reference.as_ref()), Some(204.0));
    assert_eq!(level(view(&dataset, "v02").reference.as_ref()), None);
    assert_eq!(view(&dataset, "v05").reference.as_ref().map(|image| image.width), Some(SIZE.0));
}

#[test]
fn points_of_another_world_are_transformed_into_the_views() {
    let folder = Folder::lom();
    let rotation = DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -1.0).normalize(), 2.0);
    let elsewhere = |point: DVec3| 0.3 * (rotation * point) + DVec3::new(5.0, -6.0, 7.0);
    let mut moved = model(10);
    for (_, pose, ..) in &mut moved.images {
        let center = pose.inverse().translation;
        pose.matrix3 *= DMat3::from_quat(rotation.inverse());
        pose.translation = -(pose.matrix3 * elsewhere(center));
    }
    moved.points.iter_mut().for_each(|(_, position, _)| *position = elsewhere(*position));
    moved.write_binary(&folder.join("colmap_sparse/0"));
    let dataset = load(&folder);
    assert_eq!(dataset.points.len(), 20);
    for (ours, (_, position, _)) in dataset.points.iter().zip(&model(10).points) {
        assert!(ours.position.distance(*position) < 1e-9, "{} is not {position}", ours.position);
    }
    assert_eq!(dataset.points[1].views, [2, 5, 8]);

    // One camera is displaced by a third of the ring: the worlds do not match.
    moved.images[4].1.translation += DVec3::splat(0.3);
    moved.write_binary(&folder.join("colmap_sparse/0"));
    assert!(load(&folder).points.is_empty());
}

#[test]
fn downscaling_shrinks_cameras_and_photographs_together() {
    let folder = Folder::lom();
    let full = load(&folder);
    let small = load_with(&folder, LoadOptions { downscale: 1.6, ..Default::default() });
    for (full, small) in full.views.iter().zip(&small.views) {
        assert_eq!((small.camera.width, small.camera.height), (25, 19));
        let (a, b) =
            (full.camera.project(DVec3::ZERO).unwrap(), small.camera.project(DVec3::ZERO).unwrap());
        assert!((a * DVec2::new(25.0 / 40.0, 19.0 / 30.0)).abs_diff_eq(b, 1e-9));
        let image = small.image.as_ref().unwrap();
        assert_eq!((image.width, image.height), (25, 19));
        assert_eq!(level(Some(image)), level(full.image.as_ref()));
    }
}

#[test]
fn a_smaller_copy_of_the_photographs_rescales_their_cameras() {
    let size = json!({ "w": 80.0, "h": 63.0 });
    let folder = Folder::with_listing(3, |listing| extend(listing, &size));
    photographs_of_size(&folder, "images", 0..3, (20, 16), 1.0);
    let camera = load(&folder).views[0].camera;
    assert_eq!((camera.width, camera.height), (20, 16));
    assert!((camera.focal.x - FOCAL.x / 4.0).abs() < 1e-9);
}

#[test]
fn the_extent_is_that_of_the_training_cameras() {
    let folder = Folder::lom();
    let mut dataset = load(&folder);
    let centers: Vec<DVec3> =
        [0, 1, 3, 4, 6, 7, 8, 9].iter().map(|index| pose(*index).inverse().translation).collect();
    let mean = centers.iter().sum::<DVec3>() / 8.0;
    let radius = centers.iter().map(|center| center.distance(mean)).fold(0.0, f64::max);
    assert!((dataset.extent() - 1.1 * radius).abs() < 1e-9);
    dataset.views.truncate(1);
    assert_eq!(dataset.extent(), 1.0);
}
