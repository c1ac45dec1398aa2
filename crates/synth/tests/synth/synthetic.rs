//! The synthetic dataset has its documented layout, loads, and depends only on its options, byte for byte.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3, Vec3};
use nightsplat_core::camera::CameraModel;
use nightsplat_photographs::dataset::{Dataset, LoadOptions, NormalOptions, Point, Split, View};
use nightsplat_photographs::image::{Image, ImageFile as _};
use nightsplat_synth::{DARKENING, Night, SyntheticOptions};
use serde_json::Value;

use crate::common::{Folder, contents};
use crate::{image, light, loaded, written};

const SMALL: SyntheticOptions = SyntheticOptions {
    views: 10,
    width: 48,
    height: 36,
    seed: 5,
    fisheye: false,
    street: None,
    lamp: None,
    night: Night::NONE,
    normals: false,
};

/// Every file below a folder, by relative path.
fn files(root: &Path) -> BTreeMap<String, Vec<u8>> {
    let name = |path: PathBuf| path.to_string_lossy().replace('\\', "/");
    contents(root).into_iter().map(|(path, bytes)| (name(path), bytes)).collect()
}

#[test]
fn equal_options_give_equal_bytes_and_another_seed_gives_different_ones() {
    let first = files(&written(&SMALL));
    assert_eq!(first, files(&written(&SMALL)));
    let other = files(&written(&SyntheticOptions { seed: 6, ..SMALL }));
    for changed in ["low/003.png", "high/003.png", "colmap_sparse/0/points3D.txt"] {
        assert_ne!(first[changed], other[changed], "{changed}");
    }
}

#[test]
fn the_layout_is_that_of_lom() {
    let dir = written(&SMALL);
    let files = files(&dir);
    let mut expected: Vec<String> = ["low", "high"]
        .iter()
        .flat_map(|folder| (0..10).map(move |view| format!("{folder}/{view:03}.png")))
        .collect();
    expected.extend(["train", "test", "val"].map(|split| format!("transforms_{split}.json")));
    expected.extend(
        ["cameras", "images", "points3D"].map(|list| format!("colmap_sparse/0/{list}.txt")),
    );
    expected.sort();
    assert_eq!(files.keys().cloned().collect::<Vec<_>>(), expected);

    let list = |split: &str| -> Value {
        serde_json::from_slice(&files[&format!("transforms_{split}.json")]).unwrap()
    };
    let names = |split: &str| -> Vec<String> {
        let list = list(split);
        let frames = list["frames"].as_array().unwrap().iter();
        frames.map(|frame| frame["file_path"].as_str().unwrap().to_owned()).collect()
    };
    assert_eq!(names("test"), ["high/000.png", "high/008.png"]);
    assert_eq!(names("val"), ["high/000.png"]);
    assert_eq!(names("train").len(), 8);
    assert_eq!(names("train")[0], "low/001.png");
    let train = list("train");
    assert_ne!(train["cx"], 24.0, "the principal point is to be off centre");
    assert_eq!(train["k1"], 0.0);
}

#[test]
fn the_set_loads_as_a_dataset_whose_points_project_into_their_views() {
    let dir = written(&SMALL);
    let dataset = loaded(&dir);
    assert_eq!(dataset.skipped, Vec::<String>::new());
    assert_eq!(dataset.views.len(), 10);
    assert_eq!(
        dataset.test_views().map(|view| view.name.as_str()).collect::<Vec<_>>(),
        ["000", "008"]
    );
    assert!(dataset.test_views().all(|view| view.reference.is_some()));
    assert!(dataset.points.len() > 1000, "{}", dataset.points.len());
    for point in &dataset.points {
        assert!(point.views.len() >= 2);
        for &view in &point.views {
            let camera = &dataset.views[view as usize].camera;
            let pixel = camera.project(point.position).unwrap();
            // The positions have the error of a reconstruction.
            let (width, height) = (f64::from(camera.width) + 1.0, f64::from(camera.height) + 1.0);
            assert!(
                (-1.0..width).contains(&pixel.x) && (-1.0..height).contains(&pixel.y),
                "{pixel}"
            );
        }
    }
}

#[test]
fn the_views_of_a_point_agree_on_its_colour() {
    let dir = written(&SyntheticOptions { width: 96, height: 72, ..SMALL });
    let dataset = loaded(&dir);
    let reference = |view: &View| image(&dir, &format!("high/{}.png", view.name));
    let references: Vec<Image> = dataset.views.iter().map(reference).collect();
    let spread = |point: &Point| {
        let green = point.views.iter().map(|&view| {
            let pixel = dataset.views[view as usize].camera.project(point.position).unwrap();
            references[view as usize]
                .pixel((pixel.x.max(0.0) as u32).min(95), (pixel.y.max(0.0) as u32).min(71))[1]
        });
        let (low, high) =
            green.fold((1.0f32, 0.0f32), |(low, high), value| (low.min(value), high.max(value)));
        high - low
    };
    let mut spreads: Vec<f32> = dataset.points.iter().map(spread).collect();
    spreads.sort_by(f32::total_cmp);
    // Half of the points are away from the edges of textures and objects.
    assert!(spreads[spreads.len() / 2] < 0.15, "{}", spreads[spreads.len() / 2]);
}

#[test]
fn the_dark_photograph_is_the_reference_darkened_in_linear_light() {
    let dir = written(&SMALL);
    let [low, high] = ["low/004.png", "high/004.png"].map(|name| image(&dir, name));
    let factor = light(&high) / light(&low);
    assert!((factor / DARKENING - 1.0).abs() < 0.05, "{factor}");
    let encoded_mean = |image: &Image| image.data.iter().sum::<f32>() / image.data.len() as f32;
    assert!((0.4..0.6).contains(&encoded_mean(&high)), "{}", encoded_mean(&high));
    // The noise is present: neighbours on plain surfaces differ in the dark by more than the light does.
    let roughness = |image: &Image| {
        let pairs = image.data.windows(2).map(|pair| (pair[1] - pair[0]).abs());
        let mut steps: Vec<f32> = pairs.collect();
        steps.sort_by(f32::total_cmp);
        steps[steps.len() / 4] / encoded_mean(image)
    };
    assert!(roughness(&low) > 1.3 * roughness(&high), "{} {}", roughness(&low), roughness(&high));
}

/// The floor is z = 0 in the world.
#[test]
fn normal_maps_face_the_camera_and_have_the_normal_of_the_floor() {
    let dir = written(&SyntheticOptions { normals: true, ..SMALL });
    let set = &dir;
    let (maps, others): (BTreeMap<_, _>, BTreeMap<_, _>) =
        files(set).into_iter().partition(|(name, _)| name.starts_with("normals/"));
    assert_eq!(others, files(&written(&SMALL)), "the photographs are the same");
    assert_eq!(maps.len(), 8, "{:?}", maps.keys());
    let normals = NormalOptions { load: true, ..NormalOptions::default() };
    let dataset = Dataset::load(set, &LoadOptions { normals, ..LoadOptions::default() }).unwrap();
    assert!(dataset.test_views().all(|view| view.normals.is_none()));
    for view in dataset.train_views() {
        assert_eq!(view.normals.as_ref().unwrap().packed().len(), 48 * 36);
        let map = Image::load_as_stored(set.join(format!("normals/{}.png", view.name))).unwrap();
        let mut floor = 0;
        for (x, y) in (0..36).flat_map(|y| (0..48).map(move |x| (x, y))) {
            let normal = 2.0 * Vec3::from_array(map.pixel(x, y)).as_dvec3() - 1.0;
            let ray = view.camera.in_view(DVec2::new(x.into(), y.into()) + 0.5, 1.0).unwrap();
            assert!((normal.length() - 1.0).abs() < 1e-3, "{x} {y} {normal}");
            assert!(normal.dot(ray) < 1e-3, "{x} {y} {normal}");
            let in_world = view.camera.view_from_world.matrix3.transpose() * normal;
            floor += usize::from(in_world.distance(DVec3::Z) < 1e-3);
        }
        assert!(floor > 48 * 36 / 8, "{}: {floor}", view.name);
    }
}

#[test]
fn invalid_options_are_refused() {
    let dir = Folder::empty();
    for options in [
        SyntheticOptions { views: 1, ..SMALL },
        SyntheticOptions { views: 100_000, ..SMALL },
        SyntheticOptions { width: 15, ..SMALL },
        SyntheticOptions { height: 100_000, ..SMALL },
        SyntheticOptions { street: Some(0), ..SMALL },
        SyntheticOptions { street: Some(4), fisheye: true, ..SMALL },
    ] {
        assert!(nightsplat_synth::write(&dir, &options).is_err(), "{options:?}");
    }
    assert!(files(&dir).is_empty());
}

#[test]
fn a_folder_that_cannot_be_created_is_named() {
    let dir = Folder::empty();
    fs::write(dir.join("taken"), "").unwrap();
    let problem = nightsplat_synth::write(dir.join("taken"), &SMALL).unwrap_err().to_string();
    assert!(problem.contains("taken"), "{problem}");
}

#[test]
fn every_eighth_view_is_a_test_view() {
    let dir = written(&SyntheticOptions { views: 17, width: 16, height: 16, ..SMALL });
    let dataset = loaded(&dir);
    let is_test = |(index, view): (usize, &View)| (view.split == Split::Test) == (index % 8 == 0);
    assert!(dataset.views.iter().enumerate().all(is_test));
}

#[test]
fn a_fisheye_dataset_has_one_lens_in_both_listings_and_matching_points() {
    let dir = written(&SyntheticOptions { fisheye: true, ..SMALL });
    let root = &dir;
    let listed = loaded(root);
    let camera = listed.views[0].camera;
    assert!(matches!(camera.model, CameraModel::Fisheye(_)), "{camera:?}");
    // The middle of the longer side is 65 degrees off the image's centre; nothing is outside the circle.
    let reach = camera.focal.x / 48.0;
    let CameraModel::Fisheye(lens) = camera.model else { panic!() };
    assert!((lens.angle(0.5 / reach).unwrap().to_degrees() - 65.0).abs() < 1e-9);
    assert!(listed.views.iter().all(|view| view.mask.is_none()));
    let model = fs::read_to_string(root.join("colmap_sparse/0/cameras.txt")).unwrap();
    assert!(model.contains("OPENCV_FISHEYE"), "{model}");
    let points = fs::read_to_string(root.join("colmap_sparse/0/points3D.txt")).unwrap();
    let images = fs::read_to_string(root.join("colmap_sparse/0/images.txt")).unwrap();
    // Observations of the first view, and the positions of their points.
    let seen: Vec<f64> =
        images.lines().nth(3).unwrap().split(' ').map(|n| n.parse().unwrap()).collect();
    assert!(seen.len() > 300);
    let view = listed.views.iter().find(|view| view.name == "000").unwrap();
    for observation in seen.chunks(3) {
        let id = format!("{} ", observation[2]);
        let point = points.lines().find(|line| line.starts_with(&id)).unwrap();
        let xyz: Vec<f64> = point.split(' ').skip(1).take(3).map(|n| n.parse().unwrap()).collect();
        let pixel = view.camera.project(DVec3::from_slice(&xyz)).unwrap();
        let off = pixel.distance(DVec2::new(observation[0], observation[1]));
        // Positions have the noise of a reconstruction.
        assert!(off < 0.3, "point {id}: off by {off}");
    }
}
