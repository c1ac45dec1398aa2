//! Real captures: committed excerpts, and the full ones if available.

use crate::common::{fixture, shared};

use super::*;

fn assert_counts(dataset: &Dataset, train: usize, test: usize, scene: &str) {
    let counts = (dataset.train_views().count(), dataset.test_views().count());
    assert_eq!(counts, (train, test), "{scene}");
}

/// The share of points that project into the views that see them.
fn share_of_points_in_their_views(dataset: &Dataset) -> f64 {
    let (mut inside, mut all) = (0, 0);
    for point in &dataset.points {
        for view in &point.views {
            let camera = dataset.views[*view as usize].camera;
            let size = DVec2::new(f64::from(camera.width), f64::from(camera.height));
            // The part cut off by undistortion is within a twentieth of the border.
            let seen = camera.project(point.position);
            let seen =
                seen.is_some_and(|p| p.cmpge(-0.05 * size).all() && p.cmple(1.05 * size).all());
            (inside, all) = (inside + usize::from(seen), all + 1);
        }
    }
    f64::from(inside as u32) / f64::from(all)
}

#[test]
fn a_set_in_the_layout_of_lom_loads_with_its_split_and_points() {
    let dataset = load(&fixture("lom"));
    assert_eq!(names(&dataset, Split::Train), ["001", "002"]);
    assert_eq!(names(&dataset, Split::Test), ["000"]);
    assert!(dataset.views.iter().all(|view| view.image.is_some() && view.camera.height == 24));
    assert!(dataset.test_views().all(|view| view.reference.is_some()));
    assert!(dataset.train_views().all(|view| view.reference.is_none()));
    assert_eq!(dataset.points.len(), 8);
    assert!(share_of_points_in_their_views(&dataset) > 0.999);
    assert!(dataset.skipped.is_empty(), "{:?}", dataset.skipped);
}

#[test]
fn a_handwritten_colmap_model_is_the_same_in_both_formats() {
    for form in ["text", "binary"] {
        let dataset = load(&fixture("colmap").join(form));
        // Of three photographs none is a test view.
        assert_eq!(names(&dataset, Split::Train), ["a", "b", "c"]);
        let half_turn = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        // (0.5, 0.5, 0.5, 0.5) maps x to y, y to z and z to x.
        let cycle = DMat3::from_cols(DVec3::Y, DVec3::Z, DVec3::X);
        let expected = [
            ("a", [20, 16], [25.0, 27.0], [10.0, 8.5], half_turn, [0.0, 0.0, 5.0], 20.0),
            ("b", [16, 20], [24.0, 24.0], [8.0, 10.0], DMat3::IDENTITY, [0.0, 0.0, 4.0], 40.0),
            ("c", [20, 16], [25.0, 27.0], [10.0, 8.5], cycle, [1.0, 2.0, 3.0], 60.0),
        ];
        for (name, size, focal, principal_point, matrix3, translation, grey) in expected {
            let view = view(&dataset, name);
            let camera = view.camera;
            assert_eq!([camera.width, camera.height], size, "{form}: {name}");
            assert_eq!(camera.focal.to_array(), focal, "{form}: {name}");
            assert_eq!(camera.principal_point.to_array(), principal_point, "{form}: {name}");
            let pose = DAffine3 { matrix3, translation: translation.into() };
            assert!(camera.view_from_world.abs_diff_eq(pose, 1e-12), "{form}: {name}");
            assert_eq!(level(view.image.as_ref()), Some(grey), "{form}: {name}");
        }
        let points =
            dataset.points.iter().map(|point| (point.position.to_array(), &point.views[..]));
        // By id.
        let expected: [([f64; 3], &[u32]); 3] =
            [([0.0; 3], &[0]), ([0.5, -0.25, 1.0], &[0, 1]), ([1.0, 2.0, 3.0], &[1, 2])];
        assert!(points.eq(expected), "{form}: {:?}", dataset.points);
    }
}

#[test]
fn the_lom_scenes_load_with_their_splits_and_points() {
    for (scene, train, test, points) in
        [("chair", 43, 5, 2267), ("sofa", 29, 4, 800), ("shrub", 30, 5, 8680)]
    {
        let Some(root) = shared(&format!("data/lom/{scene}")) else { continue };
        let dataset = load_with(&root, LoadOptions { downscale: 2.0, ..Default::default() });
        assert_counts(&dataset, train, test, scene);
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
        let Some(root) = shared(&format!("data/realx3d/{scene}")) else { continue };
        let dataset = load_with(&root, LoadOptions { downscale: 8.0, ..Default::default() });
        assert_counts(&dataset, train, test, scene);
        assert!(dataset.test_views().all(|view| view.image.is_none() && view.reference.is_none()));
        assert_eq!(dataset.skipped.len(), test, "{:?}", dataset.skipped);
        assert!(!dataset.points.is_empty());
        assert!(share_of_points_in_their_views(&dataset) > 0.999, "{scene}");
    }
}

#[test]
fn twenty_three_cameras_of_different_sizes_load_in_one_dataset() {
    let Some(root) = shared("data/fixtures/colmap_multi_camera") else { return };
    let dataset = load_with(&root, LoadOptions { downscale: 4.0, ..Default::default() });
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
    let Some(root) = shared("data/fox") else { return };
    let dataset = load(&root);
    let listed = fs::read_to_string(root.join("test.txt")).unwrap();
    let listed: Vec<_> = listed.lines().map(|line| line.trim_end_matches(".png")).collect();
    assert_eq!((dataset.views.len(), names(&dataset, Split::Test)), (50, listed.clone()));
    let test = view(&dataset, listed[0]);
    let mean = |image: &Image| image.data.iter().sum::<f32>() / image.data.len() as f32;
    let (low, normal) =
        (mean(test.image.as_ref().unwrap()), mean(test.reference.as_ref().unwrap()));
    assert!(low < 0.5 * normal, "{low} is not dark beside {normal}");
    assert!(share_of_points_in_their_views(&dataset) > 0.999);
}
