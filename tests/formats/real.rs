//! Real captures, where they are at hand.

use std::path::PathBuf;

use glam::DVec2;
use nightsplat::dataset::{Dataset, LoadOptions, Split};

use crate::{load, names, view};

/// The folder of a capture, or `None` with a word on stdout.
fn capture(name: &str) -> Option<PathBuf> {
    let root = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data")).join(name);
    if root.is_dir() {
        return Some(root);
    }
    println!("skipped: {} is absent", root.display());
    None
}

/// How many of the points appear inside the views that see them.
fn share_of_points_in_their_views(dataset: &Dataset) -> f64 {
    let (mut inside, mut all) = (0, 0);
    for point in &dataset.points {
        for view in &point.views {
            let camera = dataset.views[*view as usize].camera;
            let size = DVec2::new(f64::from(camera.width), f64::from(camera.height));
            // What the undistortion cut off lies within a twentieth of the border.
            let seen = camera.project(point.position);
            let seen =
                seen.is_some_and(|p| p.cmpge(-0.05 * size).all() && p.cmple(1.05 * size).all());
            (inside, all) = (inside + usize::from(seen), all + 1);
        }
    }
    f64::from(inside as u32) / f64::from(all)
}

#[test]
fn the_lom_scenes_load_with_their_splits_and_points() {
    for (scene, train, test, points) in
        [("chair", 43, 5, 2267), ("sofa", 29, 4, 800), ("shrub", 30, 5, 8680)]
    {
        let Some(root) = capture("lom").map(|lom| lom.join(scene)) else { continue };
        let options = LoadOptions { downscale: 2.0, ..LoadOptions::default() };
        let dataset = Dataset::load(&root, &options).unwrap();
        assert_eq!(
            (dataset.train_views().count(), dataset.test_views().count()),
            (train, test),
            "{scene}"
        );
        assert!(dataset.views.iter().all(|view| view.image.is_some() && view.camera.width == 250));
        assert!(dataset.test_views().all(|view| view.reference.is_some()));
        assert!(dataset.train_views().all(|view| view.reference.is_none()));
        assert_eq!(dataset.points.len(), points, "{scene}");
        assert!(share_of_points_in_their_views(&dataset) > 0.999, "{scene}");
        assert!(dataset.skipped.is_empty(), "{:?}", dataset.skipped);
    }
}

#[test]
fn realx3d_keeps_its_test_poses() {
    for (scene, train, test) in [("Cupcake", 30, 6), ("GearWorks", 27, 5)] {
        let Some(root) = capture("realx3d").map(|set| set.join(scene)) else { continue };
        let options = LoadOptions { downscale: 8.0, ..LoadOptions::default() };
        let dataset = Dataset::load(&root, &options).unwrap();
        assert_eq!(
            (dataset.train_views().count(), dataset.test_views().count()),
            (train, test),
            "{scene}"
        );
        assert!(dataset.test_views().all(|view| view.image.is_none() && view.reference.is_none()));
        assert_eq!(dataset.skipped.len(), test, "{:?}", dataset.skipped);
        assert!(!dataset.points.is_empty());
        assert!(share_of_points_in_their_views(&dataset) > 0.999, "{scene}");
    }
}

#[test]
fn twenty_three_cameras_of_different_sizes_load_in_one_set() {
    let Some(root) = capture("fixtures/colmap_multi_camera") else { return };
    let options = LoadOptions { downscale: 4.0, ..LoadOptions::default() };
    let dataset = Dataset::load(&root, &options).unwrap();
    assert_eq!((dataset.views.len(), dataset.points.len()), (23, 1443));
    assert_eq!(dataset.test_views().count(), 3);
    let mut sizes: Vec<_> =
        dataset.views.iter().map(|view| (view.camera.width, view.camera.height)).collect();
    sizes.sort_unstable();
    sizes.dedup();
    assert!(sizes.len() > 1, "{sizes:?}");
    assert!(share_of_points_in_their_views(&dataset) > 0.999);
}

#[test]
fn the_fox_splits_by_its_list_and_scores_against_normal_light() {
    let Some(root) = capture("fox") else { return };
    let dataset = load(&root);
    let listed = std::fs::read_to_string(root.join("test.txt")).unwrap();
    let listed: Vec<_> = listed.lines().map(|line| line.trim_end_matches(".png")).collect();
    assert_eq!((dataset.views.len(), names(&dataset, Split::Test)), (50, listed.clone()));
    let test = view(&dataset, listed[0]);
    let mean =
        |image: &nightsplat::image::Image| image.data.iter().sum::<f32>() / image.data.len() as f32;
    let (low, normal) =
        (mean(test.image.as_ref().unwrap()), mean(test.reference.as_ref().unwrap()));
    assert!(low < 0.5 * normal, "{low} is not dark beside {normal}");
    assert!(share_of_points_in_their_views(&dataset) > 0.999);
}
