//! Properties for arbitrary input: cameras, frames and lenses.

use glam::{DAffine3, DMat2, DVec2};
use nightsplat_core::camera::{Camera, CameraModel, Distortion, TrainingFrame};
use proptest::prelude::*;

use crate::arbitrary::{cases, pose, position};

fn camera() -> impl Strategy<Value = Camera> {
    (1..4000_u32, 1..4000_u32, 1.0..5000.0, 1.0..5000.0, pose()).prop_map(
        |(width, height, fx, fy, view_from_world)| Camera {
            width,
            height,
            focal: DVec2::new(fx, fy),
            principal_point: DVec2::new(0.4 * f64::from(width), 0.6 * f64::from(height)),
            model: CameraModel::Pinhole,
            view_from_world,
        },
    )
}

proptest! {
    #![proptest_config(cases(256))]

    #[test]
    fn a_point_that_is_put_behind_a_pixel_appears_at_that_pixel(
        camera in camera(), x in -0.5..1.5_f64, y in -0.5..1.5_f64, depth in 1e-3..1e4_f64,
    ) {
        let pixel = DVec2::new(x * f64::from(camera.width), y * f64::from(camera.height));
        let ray = (pixel - camera.principal_point) / camera.focal;
        let point = camera.view_from_world.inverse().transform_point3((ray * depth).extend(depth));
        let back = camera.project(point);
        // Rounding of a distant point that is seen from close by.
        let bound = 1e-12 * (1.0 + point.length() / depth) * (camera.focal.max_element() + pixel.length()) * 16.0;
        prop_assert!(back.is_some_and(|back| back.distance(pixel) <= bound), "{back:?}, not {pixel}");
        let half = camera.resized(2 * camera.width, 2 * camera.height);
        prop_assert!(half.project(point).is_some_and(|twice| twice.distance(2.0 * pixel) <= 2.0 * bound));
    }

    #[test]
    fn a_frame_shows_the_same_pixels_and_leads_back(
        camera in camera(), center in position(1e6), extent in 1e-6..1e6_f64, at in position(5.0),
    ) {
        let frame = TrainingFrame::new(center, extent);
        let world = center + extent * at;
        let back = frame.unframed(frame.framed(world));
        prop_assert!(back.distance(world) <= 1e-9 * (world.length() + extent), "{back}, not {world}");
        let view_from_world = camera.view_from_world * DAffine3::from_translation(-center);
        let camera = Camera { view_from_world, ..camera };
        let (projected, framed) = (camera.project(world), frame.camera(&camera).project(frame.framed(world)));
        prop_assert_eq!(projected.is_some(), framed.is_some());
        if let Some((projected, framed)) = projected.zip(framed) {
            let depth = camera.view_from_world.transform_point3(world).z;
            let scale = world.length() + extent * 5.0 + 10.0;
            let bound = 1e-13 * scale / depth * (projected.length() + camera.focal.max_element()) + 1e-9;
            prop_assert!(projected.distance(framed) <= 64.0 * bound, "{projected} and {framed}");
        }
    }

    #[test]
    fn the_determinant_of_a_lens_is_that_of_its_differences(
        k in [-0.1..0.1, -0.05..0.05, -0.01..0.01, -0.01..0.01_f64], p in [-0.01..0.01, -0.01..0.01_f64],
        is_fisheye in any::<bool>(), x in -0.7..0.7_f64, y in -0.7..0.7_f64,
    ) {
        let [k1, k2, k3, k4] = k;
        let [p1, p2] = if is_fisheye { [0.0; 2] } else { p };
        let lens = Distortion { k1, k2, k3, k4, p1, p2, is_fisheye, ..Distortion::default() };
        let (at, h) = (DVec2::new(x, y), 1e-6);
        let slope = |by: DVec2| (lens.distort(at + by) - lens.distort(at - by)) / (2.0 * h);
        let differences = DMat2::from_cols(slope(DVec2::X * h), slope(DVec2::Y * h));
        prop_assert!((differences.determinant() - lens.determinant(at)).abs() < 1e-6);
    }
}
