//! The backward pass: central differences of the f64 chain, the renderer against the chain, the same bits every time.

use nightsplat::reference;
use nightsplat::reference::camera::ReferenceLens;
use nightsplat::splats::lamp::Lamp;

use crate::common::chain::Chain;
use crate::common::prelude::*;
use crate::common::setup::{Gradients, Rendered, features, fisheye, lamp, tile_of, variants};

const SIZE: [u32; 2] = [26, 19];

/// Compares the chain's gradient with central differences, relative to the largest of each attribute, and the renderer
/// with the chain.
fn check(setup: &Setup, name: &str) {
    let chain = Chain::new(setup);
    let (parameters, background) = (chain.parameters(), chain.background());
    let results = chain.run(&parameters);
    let gradient = &results.gradient;
    let difference = |values: &[f64], at: usize, loss: &dyn Fn(&[f64]) -> f64| {
        let step = 1e-5;
        let moved = |by: f64| {
            let mut values = values.to_vec();
            values[at] += by;
            loss(&values)
        };
        (moved(step) - moved(-step)) / (2.0 * step)
    };
    let (count, rest) = (setup.count, 14 + setup.planes().feature_count);
    for (attribute, first, end) in [
        ("means", 0, 3),
        ("quats", 3, 7),
        ("log_scales", 7, 10),
        ("raw_opacities", 10, 11),
        ("dc", 11, 14),
        ("features", 14, rest),
        ("rest", rest, gradient.len() / count),
    ] {
        let range = first * count..end * count;
        let largest = gradient[range.clone()].iter().fold(0.0f64, |a, g| a.max(g.abs()));
        assert!(largest > 1e-3 || range.is_empty(), "{name}: the gradient of {attribute} is zero");
        for at in range {
            let expected = difference(&parameters, at, &|p| chain.loss(p, &background));
            let actual = gradient[at];
            // The second term is the rounding error of the loss, divided by the step.
            let bound = 1e-6 * largest + 1e-9;
            let error = (actual - expected).abs();
            assert!(error < bound, "{name}: {attribute} [{at}] {actual} is not {expected}");
        }
    }
    for (c, &actual) in results.d_background.iter().enumerate() {
        let expected = difference(&background, c, &|b| chain.loss(&parameters, b));
        assert!((actual - expected).abs() < 1e-6 * expected.abs(), "{name}: background");
    }
    chain.assert_agrees_with_the_device(name);
}

#[test]
fn the_chain_s_gradients_agree_with_central_differences() {
    for degree in 0..=3 {
        check(&Setup::new(7, SIZE, degree, 21 + u64::from(degree)), &format!("degree {degree}"));
    }
}

#[test]
fn the_chain_s_gradients_agree_with_central_differences_through_a_fisheye() {
    for degree in [0, 2] {
        let setup = Setup::seen_by(fisheye(), 7, SIZE, degree, 21 + u64::from(degree));
        check(&setup, &format!("fisheye, degree {degree}"));
    }
}

/// The mean depth is the last channel, after features too.
#[test]
fn the_gradient_of_mean_depths_agrees_with_central_differences() {
    for (model, channels) in [(CameraModel::Pinhole, 3), (fisheye(), 3), (CameraModel::Pinhole, 5)]
    {
        let shape = Shape { sh_degree: 1, features: features(channels) };
        let mut setup = Setup::seen_by(model, 7, SIZE, shape, 23);
        setup.settings.trains_depth = true;
        check(&setup, &format!("mean depth, {model:?}, {channels}"));
    }
}

/// The scales of a test are about a pixel, where most of the gradient is the compensation's.
#[test]
fn the_gradient_of_compensated_opacities_agrees_with_central_differences() {
    for model in [CameraModel::Pinhole, fisheye()] {
        let mut setup = Setup::seen_by(model, 7, SIZE, 1, 23);
        setup.settings.antialiased = true;
        for i in 0..7 {
            let gaussian = setup.get(i);
            let log_scale = gaussian.log_scale - 0.1 * i as f64;
            setup.set(i, &Gaussian { raw_opacity: 1.5, log_scale, ..gaussian });
        }
        check(&setup, &format!("compensated, {model:?}"));
    }
}

/// Every attribute with a lamp, which also acts on means, and the numbers of the lamp.
#[test]
fn the_gradient_of_lit_colors_and_of_their_lamp_agrees_with_central_differences() {
    for (model, channels, reach) in
        [(CameraModel::Pinhole, 3, 0.6), (fisheye(), 11, 0.6), (CameraModel::Pinhole, 3, 0.0)]
    {
        let shape = Shape { sh_degree: 1, features: features(channels) };
        let mut setup = Setup::seen_by(model, 7, SIZE, shape, 23);
        setup.settings.lamp = Some(Lamp { reach, ..lamp() });
        setup.settings.raw_colors = channels > 3;
        check(&setup, &format!("lit, {model:?}"));
        let mut chain = Chain::new(&setup);
        let (parameters, background) = (chain.parameters(), chain.background());
        let actual = chain.run(&parameters).lamp;
        let numbers = Lamp { reach, ..lamp() }.numbers().map(f64::from);
        let step = 1e-5;
        for (number, actual) in actual.into_iter().enumerate() {
            let mut loss = |by: f64| {
                let mut moved = numbers;
                moved[number] += by;
                chain.lamp = Some(reference::lamp::ReferenceLamp::from_numbers(&moved));
                chain.loss(&parameters, &background)
            };
            let expected = (loss(step) - loss(-step)) / (2.0 * step);
            let bound = 1e-6 * expected.abs() + 1e-8;
            assert!(expected.abs() > 1e-4, "number {number} has no gradient");
            assert!((actual - expected).abs() < bound, "[{number}] {actual}, not {expected}");
        }
    }
}

/// Within the lamp, where distances are bounded, nothing depends on the distance, but the angle counts.
#[test]
fn the_gradient_is_correct_at_the_lamp_and_opposite_to_its_axis() {
    let mut setup = Setup::new(7, SIZE, 1, 23);
    let in_view = setup.camera().view(setup.get(0).mean);
    let position = (in_view + DVec3::new(0.02, -0.01, 0.03)).to_array();
    setup.settings.lamp = Some(Lamp { position, ..lamp() });
    check(&setup, "at the lamp");
    setup.settings.lamp = Some(Lamp { position: [0.0, 0.0, 4.0], ..lamp() });
    check(&setup, "opposite to the axis");
}

#[test]
fn the_gradient_of_a_lamp_on_the_device_is_that_of_the_chain_and_has_the_same_bits_every_time() {
    let gpu = gpu();
    for (count, channels) in [(0, 3), (7, 3), (1023, 4), (1025, 11), (2600, 3)] {
        let shape = Shape { sh_degree: 1, features: features(channels) };
        let mut setup = Setup::new(count, [40, 30], shape, 8);
        setup.settings.lamp = Some(lamp());
        let chain = Chain::new(&setup);
        let expected = chain.run(&chain.parameters()).lamp;
        let d_render: Vec<f32> = chain.d_render.iter().map(|&d| d as f32).collect();
        let gradient = || {
            let mut rendered = setup.render();
            agreeing(|| rendered.backward(&d_render));
            gpu.read(rendered.renderer.lamp_gradients().unwrap()).unwrap()
        };
        let actual = gradient();
        let largest = expected.iter().fold(0.0_f64, |largest, d| largest.max(d.abs()));
        for (n, (actual, expected)) in actual.iter().zip(expected).enumerate() {
            let off = (f64::from(*actual) - expected).abs();
            assert!(off <= 2e-3 * largest, "{count}: [{n}] {actual} {expected}");
        }
        assert!((0..3).all(|_| gradient() == actual), "{count}");
    }
}

#[test]
fn gradients_of_features_and_raw_colors_agree_with_central_differences_of_the_chain() {
    for (channels, raw_colors) in [(5, false), (11, true)] {
        let shape = Shape { sh_degree: 1, features: features(channels) };
        let mut setup = Setup::new(7, SIZE, shape, 61);
        setup.settings.raw_colors = raw_colors;
        check(&setup, &format!("{channels} channels"));
    }
}

#[test]
fn coefficients_above_the_degree_in_use_have_no_gradient() {
    let mut setup = Setup::new(7, SIZE, 3, 31);
    setup.options.sh_degree = 1;
    check(&setup, "SH degree 1 of 3");
    let gradients = setup.render().backward(&vec![1.0; 3 * setup.pixels()]);
    let above = (0..7).flat_map(|i| setup.planes().load(&gradients.parameters, i).sh.split_off(4));
    assert!(above.into_iter().all(|coefficient| coefficient == DVec3::ZERO));
}

#[test]
fn the_gradient_is_correct_where_the_slope_is_clamped() {
    let mut setup = Setup::new(5, SIZE, 1, 41);
    let camera = setup.camera();
    let ReferenceLens::Pinhole(pinhole) = &camera.model else { panic!("{camera:?}") };
    for (i, x, y) in [(0, 1.3, 0.5), (1, -0.4, 0.4), (2, 0.5, 1.5), (3, 1.3, -0.3)] {
        let depth = 2.0 + 0.3 * i as f64;
        let mean = setup.at_pixel(DVec2::new(x, y) * camera.size, depth);
        let slope = camera.view(mean).truncate() / depth;
        let clamped = pinhole.clamped_slope(camera.view(mean));
        assert!((clamped - slope).length() > 1e-3, "not clamped");
        let log_scale = DVec3::new(-0.3, -0.6, -0.1);
        setup.set(i, &Gaussian { mean, log_scale, raw_opacity: 1.0, ..setup.get(i) });
    }
    check(&setup, "clamped slope");
}

#[test]
fn the_gradient_is_correct_through_capped_alphas_and_done_pixels() {
    let mut setup = Setup::new(12, [16, 12], 1, 51);
    for i in 0..12 {
        let gaussian = setup.get(i);
        let log_scale = gaussian.log_scale + 1.2;
        setup.set(i, &Gaussian { raw_opacity: 2.0 + 0.5 * i as f64, log_scale, ..gaussian });
    }
    let chain = Chain::new(&setup);
    let transmittances = chain.run(&chain.parameters()).transmittances;
    assert!(transmittances.into_iter().any(|t| t < 5e-4), "nothing is opaque");
    check(&setup, "opaque");
}

#[test]
fn the_gradient_is_correct_where_one_part_of_a_tile_is_done_before_another() {
    for (channels, subgroups) in [(3, 2), (3, 4), (11, 4)] {
        let mut setup = Setup::opaque_above(channels);
        let tile = tile_of(([16, 16], subgroups));
        setup.settings.tile = Some(tile).filter(|&tile| gpu().properties().suits_tile(tile));
        let chain = Chain::new(&setup);
        let transmittances = chain.run(&chain.parameters()).transmittances;
        assert!(transmittances[2 * 32 + 16] < 5e-4 && transmittances[14 * 32 + 16] > 5e-4);
        chain.assert_agrees_with_the_device(&format!("{channels} channels, {tile}"));
    }
}

/// A splat of some pixels under a checkerboard, and between a brighter and a darker half.
#[test]
fn the_pulls_of_fine_texture_cancel_in_their_sum_and_add_up_in_the_sum_of_norms() {
    let mut setup = Setup::new(1, [32, 24], 0, 3);
    let mean = setup.at_pixel(DVec2::new(16.0, 12.0), 3.0);
    let log_scale = DVec3::splat((4.0 * 3.0 / setup.camera.focal.x).ln());
    let sh = vec![DVec3::ONE];
    setup.set(0, &Gaussian { mean, log_scale, raw_opacity: 0.0, sh, ..setup.get(0) });
    let mut norm = |is_trained: bool, pull: fn(usize, usize) -> bool| {
        setup.is_trained = is_trained;
        let pulls = (0..3 * setup.pixels()).map(|at| pull(at % 32, at / 32 % 24));
        let d_render: Vec<f32> = pulls.map(|brighter| if brighter { -1.0 } else { 1.0 }).collect();
        setup.render().backward(&d_render).grad_norm_sums[0] - Rendered::NORM_BEFORE
    };
    let (fine, halves) =
        (|x: usize, y: usize| (x + y).is_multiple_of(2), |x: usize, _: usize| x < 16);
    let [sum_of_fine, norms_of_fine] = [false, true].map(|is_trained| norm(is_trained, fine));
    let [sum_of_halves, norms_of_halves] = [false, true].map(|is_trained| norm(is_trained, halves));
    assert!(norms_of_fine > 100.0 * sum_of_fine, "{norms_of_fine} {sum_of_fine}");
    assert!(norms_of_halves < 3.0 * sum_of_halves, "{norms_of_halves} {sum_of_halves}");
    assert!((norms_of_fine / norms_of_halves - 1.0).abs() < 0.1);
}

#[test]
fn the_renderer_gives_the_chain_s_values() {
    for setup in variants() {
        let name = format!("{} Gaussians, {:?}", setup.count, setup.settings);
        Chain::new(&setup).assert_agrees_with_the_device(&name);
    }
}

#[test]
fn an_overflow_gives_no_gradient_and_no_statistics() {
    let setup = Setup::new(65, [50, 40], 1, 5);
    let (mut rendered, status) = setup.render_within(3);
    assert!(status.overflowed);
    let gradients = rendered.backward(&vec![1.0; rendered.render.len()]);
    assert!(gradients.parameters.iter().all(|&d| d == 0.0));
    let Gradients { grad_norm_sums, visit_counts, .. } = gradients;
    let untouched = (vec![Rendered::NORM_BEFORE; 65], vec![Rendered::VISITS_BEFORE; 65]);
    assert_eq!((grad_norm_sums, visit_counts), untouched);
}

/// Sums have a fixed order, in the subgroups of `blend_backward` and over the slots in `project_backward`.
#[test]
fn the_same_frame_gives_the_same_bits_every_time() {
    let shape = Shape { sh_degree: 2, features: features(4) };
    let mut setup = Setup::new(777, [131, 77], shape, 8);
    let mut d_render = vec![0.0; 4 * setup.pixels()];
    (0..).zip(&mut d_render).for_each(|(i, d)| *d = ((i % 17) as f32 - 8.0) / 8.0);
    let bits = |setup: &Setup| -> Vec<u32> {
        let mut rendered = setup.render();
        let Gradients { parameters, grad_norm_sums, visit_counts } = rendered.backward(&d_render);
        let Rendered { render, transmittances, .. } = rendered;
        let floats = [render, transmittances, parameters, grad_norm_sums].concat();
        floats.into_iter().map(f32::to_bits).chain(visit_counts).collect()
    };
    let tiles = [([16, 8], 1), ([16, 16], 4)].map(tile_of);
    for tile in tiles.into_iter().filter(|&tile| gpu().properties().suits_tile(tile)) {
        setup.settings.tile = Some(tile);
        let first = bits(&setup);
        for repetition in 1..25 {
            assert!(bits(&setup) == first, "{tile}: repetition {repetition}");
        }
    }
}
