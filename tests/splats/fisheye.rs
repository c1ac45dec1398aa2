//! The native fisheye: golden projections, culling, gradients, and a complete render against the f64 chain.

use std::f64::consts::FRAC_PI_2;

use glam::DVec4;
use nightsplat::kernels;
use nightsplat::reference::camera;
use nightsplat_core::camera::{KannalaBrandt, Patch};

use crate::common::chain::Chain;
use crate::common::prelude::*;
use crate::common::setup::{Rendered, features, fisheye};

const COEFFICIENTS: [[f64; 4]; 3] =
    [[0.0; 4], [0.05, -0.02, 0.006, -0.001], [-0.0124, 0.0044, -0.0031, 0.0005]];

/// A camera at the origin that looks along z, 180 degrees across its width.
fn camera(coefficients: [f64; 4]) -> Camera {
    let lens = KannalaBrandt { coefficients: coefficients.map(|k| f64::from(k as f32)) };
    Camera {
        width: 64,
        height: 48,
        focal: DVec2::new(20.0, 21.0),
        principal_point: DVec2::new(31.0, 25.0),
        model: CameraModel::Fisheye(lens),
        view_from_world: DAffine3::IDENTITY,
    }
}

fn reference(camera: &Camera) -> camera::ReferenceCamera {
    camera::ReferenceCamera::from(&kernels::Camera::from(&Patch::from(camera)))
}

/// The formula from the documentation of `cv::fisheye::projectPoints`.
fn published(camera: &Camera, point: DVec3) -> DVec2 {
    let CameraModel::Fisheye(KannalaBrandt { coefficients: [k1, k2, k3, k4] }) = camera.model
    else {
        panic!("{camera:?}")
    };
    let (a, b) = (point.x / point.z, point.y / point.z);
    let r = (a * a + b * b).sqrt();
    let theta = r.atan();
    let theta_d = theta
        * (1.0 + k1 * theta.powi(2) + k2 * theta.powi(4) + k3 * theta.powi(6) + k4 * theta.powi(8));
    let (x, y) = (theta_d / r * a, theta_d / r * b);
    camera.focal * DVec2::new(x, y) + camera.principal_point
}

#[test]
fn points_project_as_opencv_s_formula_states() {
    let mut random = Random::new(3);
    for camera in COEFFICIENTS.map(camera) {
        let reference = reference(&camera);
        for _ in 0..200 {
            let across = DVec2::new(random.between(-9.0, 9.0), random.between(-9.0, 9.0));
            let point = across.extend(random.between(0.05, 9.0));
            let expected = published(&camera, point);
            for actual in [camera.project(point).unwrap(), reference.project(point)] {
                assert!(actual.distance(expected) < 1e-9, "{point}: {actual}, not {expected}");
            }
        }
    }
}

/// A Gaussian of one pixel at each of `points`.
fn dots(camera: &Camera, points: &[DVec3]) -> Setup {
    let mut setup = Setup::new(points.len(), [64, 48], 0, 7);
    setup.camera = *camera;
    for (i, &mean) in points.iter().enumerate() {
        let log_scale = DVec3::splat((0.02 * mean.length()).ln());
        let quat = DVec4::X;
        setup.set(i, &Gaussian { mean, quat, log_scale, raw_opacity: 3.0, ..setup.get(i) });
    }
    setup
}

#[test]
fn the_device_projects_splats_as_opencv_s_formula_states() {
    let mut random = Random::new(4);
    for camera in COEFFICIENTS.map(camera) {
        // Up to a tenth of a degree from the edge of the half space.
        let point = |_| {
            let (sin, cos) = random.between(0.0, FRAC_PI_2 - 2e-3).sin_cos();
            let turn = DVec2::from_angle(random.between(0.0, 6.2));
            ((sin * turn).extend(cos) * random.between(0.5, 50.0)).as_vec3().as_dvec3()
        };
        let points: Vec<DVec3> = (0..500).map(point).collect();
        let setup = dots(&camera, &points);
        let rendered = setup.render();
        let splats = gpu().read(&rendered.renderer.frame().splats).unwrap();
        for (&point, splat) in points.iter().zip(&splats) {
            let off = splat.mean2d.as_dvec2().distance(published(&camera, point));
            assert!(off < 2e-5, "{point}: off by {off} pixels");
        }
    }
}

#[test]
fn nothing_is_seen_at_90_degrees_or_behind_or_where_the_polynomial_falls() {
    // Rises until 70.0 degrees; points beyond would be projected into the image again.
    let fold = [-0.2231, 0.0, 0.0, 0.0];
    for camera in [camera([0.0; 4]), camera(fold)] {
        let CameraModel::Fisheye(lens) = camera.model else { panic!() };
        let largest = lens.largest_angle().to_degrees();
        let at = |degrees: f64, turn: f64| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            3.0 * (sin * DVec2::from_angle(turn)).extend(cos)
        };
        let mut points = vec![DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z, DVec3::ZERO, DVec3::NAN];
        points.extend([DVec3::splat(f64::INFINITY), DVec3::new(1e30, -1e30, 3.0)]);
        points.push(DVec3::new(0.0, 0.0, f64::INFINITY));
        for turn in [0.0, 1.0, 2.5, 4.0] {
            points.extend([0.01, 1.0, 20.0, 89.0].map(|more| at(largest + more, turn)));
            points.extend([91.0, 120.0, 179.0].map(|degrees| at(degrees, turn)));
        }
        let mut setup = dots(&camera, &points);
        let mut rendered = setup.render();
        assert_eq!(gpu().read(&rendered.renderer.frame().lists.counts).unwrap(), [0]);
        assert!(rendered.transmittances.iter().all(|&t| t == 1.0));
        let gradients = rendered.backward(&vec![1.0; rendered.render.len()]);
        assert!(gradients.parameters.iter().all(|&g| g == 0.0));
        assert!(gradients.visit_counts.iter().all(|&visits| visits == Rendered::VISITS_BEFORE));
        // The near limit applies to the distance.
        let near = f64::from(setup.settings.near);
        for (distance, is_seen) in [(near * 0.99, false), (near * 1.01, true)] {
            setup = dots(&camera, &[at(60.0, 0.5) / 3.0 * distance]);
            let count = gpu().read(&setup.render().renderer.frame().lists.counts).unwrap()[0];
            assert_eq!(count > 0, is_seen, "{distance}");
        }
    }
}

#[test]
fn wide_splats_at_the_edge_of_the_view_stay_finite() {
    let camera = camera([0.05, -0.02, 0.006, -0.001]);
    let mut points = vec![DVec3::Z];
    for degrees in [1e-5, 1e-3, 0.1, 45.0, 85.0, 89.9, 89.999] {
        let (sin, cos) = f64::to_radians(degrees).sin_cos();
        points
            .extend([0.3, 1.9, 4.0].map(|turn| 2.0 * (sin * DVec2::from_angle(turn)).extend(cos)));
    }
    let mut setup = dots(&camera, &points);
    for i in 0..setup.count {
        let log_scale = DVec3::new(1.5, -3.0, 0.2 * i as f64 - 2.0);
        let quat = DVec4::new(1.0, 0.3, -0.2, 0.1);
        setup.set(i, &Gaussian { log_scale, quat, ..setup.get(i) });
    }
    let mut rendered = setup.render();
    let gradients = rendered.backward(&vec![1.0; rendered.render.len()]);
    let seen = gradients.visit_counts.iter().filter(|&&visits| visits > Rendered::VISITS_BEFORE);
    assert_eq!(seen.count(), points.len());
    let all = [rendered.render, gradients.parameters, gradients.grad_norm_sums].concat();
    assert!(all.iter().all(|value| value.is_finite()));
}

/// Central differences of the position and of the Jacobian in f64, from the axis to the edge.
#[test]
fn jacobian_and_gradient_of_a_point_agree_with_central_differences() {
    let mut random = Random::new(5);
    for camera in COEFFICIENTS.map(|k| reference(&camera(k))) {
        for degrees in [0.0, 1e-3, 0.05, 1.0, 1.2, 30.0, 60.0, 89.0] {
            let (sin, cos) = f64::to_radians(degrees).sin_cos();
            let turn = DVec2::from_angle(random.between(0.0, 6.2));
            let point = 1.7 * (sin * turn).extend(cos);
            let d_pixel = DVec2::from_array([0; 2].map(|_| random.between(-1.0, 1.0)));
            let d_rows =
                [0; 2].map(|_| DVec3::from_array([0; 3].map(|_| random.between(-1.0, 1.0))));
            let value = |point: DVec3| {
                let [row0, row1] = camera.jacobian(point);
                let rows = row0.dot(d_rows[0]) + row1.dot(d_rows[1]);
                (camera.project(point), rows + camera.project(point).dot(d_pixel))
            };
            let gradient = camera.backward(point, d_pixel, d_rows);
            for axis in 0..3 {
                let step = 1e-5 * DVec3::AXES[axis];
                let (after, before) = (value(point + step), value(point - step));
                let expected = (after.0 - before.0) / 2e-5;
                let actual = camera.jacobian(point).map(|row| row[axis]);
                let off = expected.distance(DVec2::from_array(actual));
                assert!(off < 1e-6, "{degrees} degrees, axis {axis}: {expected}, not {actual:?}");
                let expected = (after.1 - before.1) / 2e-5;
                let off = (expected - gradient[axis]).abs();
                assert!(off < 1e-5, "{degrees} degrees, axis {axis}: {expected}, {gradient}");
            }
        }
    }
}

#[test]
fn the_renderer_gives_the_chain_s_values_through_a_fisheye_of_180_degrees() {
    let shape = Shape { sh_degree: 2, features: features(4) };
    let mut setup = Setup::seen_by(fisheye(), 150, [70, 56], shape, 12);
    // The left and right edges are beyond 80 degrees, the corners out of view.
    setup.camera.focal = DVec2::new(24.0, 23.0);
    for i in 0..setup.count {
        let pixel = DVec2::new((i % 15) as f64 * 5.0, (i / 15) as f64 * 6.0);
        let mean = setup.at_pixel(pixel, 2.0 + 0.01 * i as f64);
        let log_scale = setup.get(i).log_scale - 0.5;
        setup.set(i, &Gaussian { mean, log_scale, ..setup.get(i) });
    }
    Chain::new(&setup).assert_agrees_with_the_device("180 degrees");
}

#[test]
fn a_fisheye_without_distortion_is_like_a_pinhole_near_its_axis() {
    let size = [40, 30];
    let mut setup = Setup::new(30, size, 1, 9);
    // One degree to the corners: tangents equal angles to four digits.
    setup.camera.focal = DVec2::splat(2000.0);
    for i in 0..30 {
        let pixel = DVec2::new((7 * i % 40) as f64, (11 * i % 30) as f64);
        let depth = 3.0 + 0.1 * i as f64;
        let mean = setup.at_pixel(pixel, depth);
        let log_scale = DVec3::splat((3.0 * depth / 2000.0).ln());
        setup.set(i, &Gaussian { mean, log_scale, ..setup.get(i) });
    }
    let pinhole = setup.render().render;
    setup.camera.model = CameraModel::Fisheye(KannalaBrandt::default());
    assert_close("render", &setup.render().render, &pinhole, |_, _| 5e-3);
}

#[test]
fn one_renderer_renders_a_pinhole_and_a_fisheye_in_turn() {
    let pinhole = Setup::new(40, [50, 40], 1, 5);
    let mut of_fisheye = pinhole.clone();
    of_fisheye.camera.model = fisheye();
    let alone = [&pinhole, &of_fisheye].map(|setup| setup.render().render);
    assert!(alone[0] != alone[1]);
    let Rendered { mut renderer, .. } = pinhole.render();
    let gaussians = pinhole.upload();
    for _ in 0..2 {
        for (setup, alone) in [&pinhole, &of_fisheye].into_iter().zip(&alone) {
            let Setup { camera, options, .. } = setup;
            let rendered = renderer.render_channels(&gaussians, camera, options).unwrap();
            assert!(rendered == *alone, "{:?}", camera.model);
        }
    }
}

#[test]
fn the_same_view_gives_the_same_bits_every_time() {
    let setup = Setup::seen_by(fisheye(), 400, [90, 70], 1, 6);
    let run = || {
        let mut rendered = setup.render();
        let gradients = rendered.backward(&vec![0.5; rendered.render.len()]);
        (rendered.render, gradients)
    };
    let first = run();
    assert!((0..10).all(|_| run() == first));
}
