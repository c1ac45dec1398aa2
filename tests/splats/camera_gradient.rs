//! The gradient of a camera from `camera_backward` and `camera_gradient`: central differences of the f64 chain, the
//! device against the chain, and the same bits every time.

use glam::{DMat3, DVec3};
use nightsplat::camera::CameraModel;
use nightsplat::gpu::testing::gpu;
use nightsplat::reference::camera::{Camera, Model};
use nightsplat::splats::render::CameraGradient;

use crate::common::chain::Chain;
use crate::common::setup::{Setup, features, fisheye};
use nightsplat::splats::scene::Shape;

const WIDTH: usize = CameraGradient::WIDTH;

/// The camera with one of the numbers of its gradient shifted.
fn moved(camera: &Camera, number: usize, by: f64) -> Camera {
    let mut camera = camera.clone();
    match number {
        0..3 => camera.translation[number] += by,
        3..6 => {
            let turn = DMat3::from_axis_angle(DVec3::AXES[number - 3], by);
            camera.rotation = turn * camera.rotation;
            camera.translation = turn * camera.translation;
        }
        6..8 => camera.focal[number - 6] += by,
        8..10 => camera.principal_point[number - 8] += by,
        _ => {
            if let Model::Fisheye(fisheye) = &mut camera.model {
                fisheye.distortion[number - 10] += by;
            }
        }
    }
    camera
}

fn setups() -> [Setup; 5] {
    let shape = Shape { sh_degree: 1, features: features(5) };
    let mut antialiased = Setup::new(7, [26, 19], 2, 23);
    antialiased.settings.antialiased = true;
    [
        Setup::new(7, [26, 19], 2, 23),
        Setup::seen_by(fisheye(), 7, [26, 19], 2, 23),
        Setup::new(6, [26, 19], shape, 61),
        Setup::seen_by(fisheye(), 6, [26, 19], shape, 61),
        antialiased,
    ]
}

#[test]
fn the_gradient_of_a_camera_agrees_with_central_differences() {
    for setup in setups() {
        let chain = Chain::new(&setup);
        let (parameters, background) = (chain.parameters(), chain.background());
        let (camera, actual) = (setup.camera(), chain.run(&parameters).camera);
        for (group, numbers) in [
            ("shift", 0..3),
            ("turn", 3..6),
            ("focal lengths", 6..8),
            ("principal point", 8..10),
            ("distortion", 10..14),
        ] {
            let largest = actual[numbers.clone()].iter().fold(0.0_f64, |a, g| a.max(g.abs()));
            let is_there = group != "distortion" || setup.camera.model != CameraModel::Pinhole;
            assert_eq!(largest > 1e-4, is_there, "{group}: {largest}");
            for number in numbers {
                let step = 1e-6;
                let loss =
                    |by| chain.loss_seen_by(&moved(&camera, number, by), &parameters, &background);
                let expected = (loss(step) - loss(-step)) / (2.0 * step);
                let off = (actual[number] - expected).abs();
                let actual = actual[number];
                assert!(off < 1e-5 * largest + 1e-7, "{group} [{number}] {actual}, not {expected}");
            }
        }
    }
}

/// The gradient on the device, with every pass checked against its reference.
fn gradient_of(setup: &Setup, d_render: &[f32]) -> Vec<f32> {
    let gpu = gpu();
    let mut rendered = setup.render();
    let gradients = gpu.buffer("gradients", &rendered.backward(d_render).parameters).unwrap();
    let mut gradient = gpu.buffer("gradient", &[f32::NAN; WIDTH]).unwrap();
    let mut of_camera =
        CameraGradient::new(&rendered.renderer, setup.camera.model, setup.count).unwrap();
    let (done, report) = gpu.checked(|| {
        gpu.run("camera", |pass| {
            let both = (&rendered.gaussians, &gradients);
            of_camera.record(pass, &rendered.renderer, both, &setup.camera, &mut gradient)
        })
    });
    done.and_then(|()| report.agree()).unwrap();
    gpu.read(&gradient).unwrap()
}

#[test]
fn the_device_agrees_with_the_chain_and_gives_the_same_bits_every_time() {
    let many = Setup::seen_by(fisheye(), 300, [70, 53], 1, 8);
    for setup in setups().into_iter().chain([many]) {
        let chain = Chain::new(&setup);
        let expected = chain.run(&chain.parameters()).camera;
        let d_render: Vec<f32> = chain.d_render.iter().map(|&d| d as f32).collect();
        let actual = gradient_of(&setup, &d_render);
        for numbers in [0..3, 3..6, 6..8, 8..10, 10..14] {
            let largest = expected[numbers.clone()].iter().fold(0.0_f64, |a, g| a.max(g.abs()));
            for number in numbers {
                let off = (f64::from(actual[number]) - expected[number]).abs();
                assert!(
                    off <= 2e-3 * largest,
                    "[{number}] {} {}",
                    actual[number],
                    expected[number]
                );
            }
        }
        assert!((0..3).all(|_| gradient_of(&setup, &d_render) == actual));
    }
}

#[test]
fn a_camera_of_another_model_is_refused() {
    let setup = Setup::new(3, [16, 16], 0, 1);
    let rendered = setup.render();
    let mut of_fisheye = CameraGradient::new(&rendered.renderer, fisheye(), 3).unwrap();
    let mut gradient = gpu().buffer("gradient", &[0.0; WIDTH]).unwrap();
    let gradients = gpu().buffer("gradients", &setup.parameters).unwrap();
    let refused = gpu().run("camera", |pass| {
        let both = (&rendered.gaussians, &gradients);
        of_fisheye.record(pass, &rendered.renderer, both, &setup.camera, &mut gradient)
    });
    assert!(refused.unwrap_err().to_string().contains("another camera model"));
}
