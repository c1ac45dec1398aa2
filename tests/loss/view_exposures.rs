//! Exposures: kernels against their references, gradients against central differences, and the mean that stays the
//! identity.

use nightsplat::kernels::exposure::{BIAS_SCALE, EXPOSURE_WIDTH};
use nightsplat::kernels::{expose, expose_backward, exposure_center, exposure_gradient};
use nightsplat::loss::exposure::{ExposureRates, Exposures};
use nightsplat::splats::optimizer::{Adam, Learnable};
use nightsplat_photographs::exposures::Affine;

use crate::common::chain::Chain;
use crate::common::prelude::*;

const WIDTH: usize = EXPOSURE_WIDTH as usize;

fn noise(seed: u64, count: usize, low: f64, high: f64) -> Vec<f32> {
    let mut random = Random::new(seed);
    (0..count).map(|_| random.between(low, high) as f32).collect()
}

#[test]
fn every_kernel_agrees_with_its_reference_at_every_size() {
    for pixels in [1, 7, 1023, 1024, 1025, 131 * 97] {
        for (view, view_count) in [(0, 1), (2, 3), (17, 40)] {
            let (pixel_count, chunk_count) = (pixels as u32, (pixels as u32).div_ceil(1024));
            // With one more plane than colours, which must not change.
            let render = noise(1, 4 * pixels, -0.2, 1.3);
            let d_render = noise(2, 4 * pixels, -1e-3, 1e-3);
            let exposures = noise(3, view_count * WIDTH, -0.5, 0.5);
            // A third of the targets are clipped, some of them a rounding of 8 bits below white.
            let whites = noise(4, 3 * view_count, 0.6, 1.0);
            let mut target = noise(5, 3 * pixels, 0.0, 0.6);
            for (i, target) in target.iter_mut().enumerate().filter(|(i, _)| i % 3 == 0) {
                let white = whites[3 * view as usize + i / pixels];
                *target = white - [0.0, 0.4, -0.4, 0.6][i % 4] / 255.0;
            }
            for inverse in [false, true] {
                let exposed = vec![7.0f32; 4 * pixels];
                let exposed = run_kernel!(
                    expose,
                    expose::Constants { inverse },
                    expose::Params { pixel_count, view },
                    Threads::Exactly([3 * pixel_count, 1, 1]),
                    [exposures, whites, render, target],
                    [exposed]
                );
                assert!(exposed[3 * pixels..].iter().all(|&value| value == 7.0));
            }
            // Half of the values are at their targets.
            let mut exposed = noise(6, 3 * pixels, 0.0, 1.0);
            exposed.iter_mut().zip(&target).step_by(2).for_each(|(value, &target)| *value = target);
            let partials = vec![Vec2::NAN; 3 * chunk_count as usize];
            let expected = d_render[3 * pixels..].to_vec();
            let (d_render, partials) = run_kernel!(
                expose_backward,
                expose_backward::Constants::default(),
                expose_backward::Params { pixel_count, view },
                Threads::Workgroups([chunk_count, 3, 1]),
                [exposures, whites, render, target, exposed],
                [d_render, partials]
            );
            assert_eq!(d_render[3 * pixels..], expected);
            let gradients = vec![f32::NAN; view_count * WIDTH];
            let gradients = run_kernel!(
                exposure_gradient,
                exposure_gradient::Constants::default(),
                exposure_gradient::Params { chunk_count, view, view_count: view_count as u32 },
                Threads::Workgroups([1, 1, 1]),
                [partials],
                [gradients]
            );
            let range = view as usize * WIDTH..(view as usize + 1) * WIDTH;
            let others = gradients.iter().enumerate().filter(|(at, _)| !range.contains(at));
            assert!(others.into_iter().all(|(_, &gradient)| gradient == 0.0));
        }
    }
}

fn centred(exposures: &[f32], status: u32) -> Vec<f32> {
    let (exposures, status) = (exposures.to_vec(), vec![status]);
    run_kernel!(
        exposure_center,
        exposure_center::Constants::default(),
        exposure_center::Params { view_count: (exposures.len() / WIDTH) as u32 },
        Threads::Workgroups([EXPOSURE_WIDTH, 1, 1]),
        [status],
        [exposures]
    )
}

/// Each number of all views.
fn columns(exposures: &[f32]) -> impl Iterator<Item = Vec<f32>> + '_ {
    (0..WIDTH).map(|number| exposures.iter().skip(number).step_by(WIDTH).copied().collect())
}

#[test]
fn the_mean_of_centred_exposures_is_the_identity_in_every_order_of_summation() {
    for views in [1, 2, 3, 7, 8, 9, 43, 300, 1025] {
        for (low, high) in [(-0.5, 0.5), (0.3, 0.4), (-3.9, -3.8), (-90.0, 90.0)] {
            let before = noise(5 + views as u64, views * WIDTH, low, high);
            let after = centred(&before, 0);
            for (column, before) in columns(&after).zip(columns(&before)) {
                let exact: f64 = column.iter().copied().map(f64::from).sum();
                assert_eq!(exact, 0.0, "{views} views from {low} to {high}");
                // In single precision, the sum of fewer than eight times the bound is exact.
                if high <= 0.5 && views < 30 {
                    let [forth, back] = [column.iter().sum::<f32>(), column.iter().rev().sum()];
                    assert_eq!([forth, back], [0.0; 2]);
                }
                // Differences between views are kept up to a rounding.
                let difference =
                    |values: &[f32]| f64::from(values[0]) - f64::from(values[views - 1]);
                let is_cut = high > 4.0;
                assert!(is_cut || (difference(&column) - difference(&before)).abs() < 2e-6);
            }
            assert!(high > 4.0 || centred(&after, 0) == after, "what is centred moved");
            assert_eq!(centred(&before, 1), before, "a step that failed changed exposures");
        }
    }
}

#[test]
fn values_that_are_not_finite_become_finite() {
    let mut exposures = noise(1, 5 * WIDTH, -0.1, 0.1);
    (exposures[0], exposures[7]) = (f32::INFINITY, f32::NEG_INFINITY);
    for column in columns(&centred(&exposures, 0)) {
        assert_eq!(column.iter().copied().map(f64::from).sum::<f64>(), 0.0);
    }
}

/// The target of white of a view in which nothing is clipped.
const WHITE: [f32; 3] = [9.0; 3];

/// Three exposures, the middle one under test.
fn three() -> [Affine; 3] {
    let second = Affine { gain: [0.7, 1.2, 0.9], bias: [0.05, -0.02, 0.01] };
    [Affine { gain: [1.3, 0.9, 1.0], bias: [-0.1, 0.0, 0.03] }, second, Affine::IDENTITY]
}

/// L = sum of w e over all values, where e is the exposed render of Gaussians.
#[test]
fn the_gradient_through_exposure_and_renderer_is_its_central_difference() {
    let gpu = gpu();
    let setup = Setup::new(7, [26, 19], 1, 33);
    let chain = Chain::new(&setup);
    let (parameters, background) = (chain.parameters(), chain.background());
    let weights = chain.d_render.clone();
    let (pixels, size) = (setup.pixels(), UVec2::new(26, 19));
    let render = crate::common::narrow(&chain.run(&parameters).render);

    let start = &three();
    let mut exposures = Exposures::new(&gpu, ExposureRates::default(), start, &[WHITE; 3]).unwrap();
    exposures.reserve(size).unwrap();
    let exact = exposures.affines().unwrap()[1];
    let render_on_device = gpu.buffer("render", &render).unwrap();
    let target = gpu.zeros("target", render.len()).unwrap();
    let mut d_render = gpu.buffer("d_render", &crate::common::narrow(&weights)).unwrap();
    gpu.run("exposures", |pass| {
        let images = [&render_on_device, &target];
        exposures.expose(pass, 1, size, images)?;
        exposures.backward(pass, 1, size, images, &mut d_render)
    })
    .unwrap();
    let d_render = crate::common::widen(&gpu.read(&d_render).unwrap());
    let gradients = gpu.read(exposures.buffers().gradients).unwrap();

    // With respect to the exposure.
    let loss = |affine: &Affine| -> f64 {
        let exposed = |(i, &c): (usize, &f32)| {
            weights[i] * (affine.gain[i / pixels] * f64::from(c) + affine.bias[i / pixels])
        };
        render.iter().enumerate().map(exposed).sum()
    };
    for number in 0..WIDTH {
        let moved = |by: f64| {
            let mut affine = exact;
            match number {
                0..3 => affine.gain[number] *= by.exp(),
                _ => affine.bias[number - 3] += BIAS_SCALE * by,
            }
            loss(&affine)
        };
        let expected = (moved(1e-3) - moved(-1e-3)) / 2e-3;
        let actual = f64::from(gradients[WIDTH + number]);
        assert!((actual - expected).abs() < 1e-4 * (1.0 + expected.abs()), "{actual} {expected}");
    }
    assert!(gradients[..WIDTH].iter().chain(&gradients[2 * WIDTH..]).all(|&d| d == 0.0));

    // With respect to the Gaussians: the chain applied to the gradient after the exposure, against differences of the
    // whole.
    let mut downstream = Chain::new(&setup);
    downstream.d_render = d_render;
    let gradient = downstream.run(&parameters).gradient;
    let mut exposed = Chain::new(&setup);
    for (i, weight) in exposed.d_render.iter_mut().enumerate() {
        *weight *= exact.gain[i / pixels];
    }
    let largest = gradient.iter().fold(0.0f64, |largest, d| largest.max(d.abs()));
    for at in 0..parameters.len() {
        let moved = |by: f64| {
            let mut parameters = parameters.clone();
            parameters[at] += by;
            exposed.loss(&parameters, &background)
        };
        let expected = (moved(1e-5) - moved(-1e-5)) / 2e-5;
        let error = (gradient[at] - expected).abs();
        assert!(error < 1e-5 * largest, "[{at}] {} is not {expected}", gradient[at]);
    }
}

/// With the loss as sum of w e: where e is above a clipped target, only that is seen.
#[test]
fn the_gradient_of_clipped_values_is_its_central_difference() {
    let (gpu, size, pixels) = (gpu(), UVec2::new(9, 7), 63);
    let (render, weights) = (noise(1, 3 * pixels, 0.0, 1.2), noise(2, 3 * pixels, -1.0, 1.0));
    let white = [0.6, 0.8, 1.0];
    let is_clipped = |i: usize| !i.is_multiple_of(3);
    let target = |i: usize| if is_clipped(i) { white[i / pixels] } else { 0.3 };
    let target: Vec<f32> = (0..3 * pixels).map(target).collect();
    let start = &three();
    let mut exposures =
        Exposures::new(&gpu, ExposureRates::default(), start, &[WHITE, white, WHITE]).unwrap();
    exposures.reserve(size).unwrap();
    let exact = exposures.affines().unwrap()[1];
    let [on_device, target_on_device] =
        [&render, &target].map(|values| gpu.buffer("image", values).unwrap());
    let mut d_render = gpu.buffer("d_render", &weights).unwrap();
    gpu.run("exposures", |pass| {
        let images = [&on_device, &target_on_device];
        exposures.expose(pass, 1, size, images)?;
        exposures.backward(pass, 1, size, images, &mut d_render)
    })
    .unwrap();
    let gradients = gpu.read(exposures.buffers().gradients).unwrap();
    let d_render = gpu.read(&d_render).unwrap();
    let exposed = |affine: &Affine, i: usize, c: f64| {
        let exposed = affine.gain[i / pixels] * c + affine.bias[i / pixels];
        if is_clipped(i) { exposed.min(target[i].into()) } else { exposed }
    };
    let mut bound = 0;
    for (i, &c) in render.iter().enumerate() {
        let difference =
            exposed(&exact, i, f64::from(c) + 1e-4) - exposed(&exact, i, f64::from(c) - 1e-4);
        let expected = f64::from(weights[i]) * difference / 2e-4;
        assert!(
            (f64::from(d_render[i]) - expected).abs() < 1e-5,
            "{i}: {} {expected}",
            d_render[i]
        );
        bound += usize::from(difference == 0.0);
    }
    assert!((20..160).contains(&bound), "{bound} values are bound by their targets");
    for number in 0..WIDTH {
        let loss = |by: f64| -> f64 {
            let mut affine = exact;
            match number {
                0..3 => affine.gain[number] *= by.exp(),
                _ => affine.bias[number - 3] += BIAS_SCALE * by,
            }
            let values = render.iter().zip(&weights).enumerate();
            values.map(|(i, (&c, &w))| f64::from(w) * exposed(&affine, i, c.into())).sum()
        };
        let expected = (loss(1e-5) - loss(-1e-5)) / 2e-5;
        let actual = f64::from(gradients[WIDTH + number]);
        assert!((actual - expected).abs() < 1e-3 * (1.0 + expected.abs()), "{actual} {expected}");
    }
}

#[test]
fn adam_finds_the_exposures_of_views_that_only_differ_in_exposure() {
    let (gpu, size) = (gpu(), UVec2::new(20, 15));
    let truth = Affine::about_their_mean(&three());
    let render = noise(8, 3 * 300, 0.0, 1.0);
    let render_on_device = gpu.buffer("render", &render).unwrap();
    let rates = ExposureRates { initial: 0.02, last: 0.002, steps: 600 };
    let start = [Affine::IDENTITY; 3];
    let mut exposures = Exposures::new(&gpu, rates, &start, &[WHITE; 3]).unwrap();
    let dark = gpu.zeros("target", 900).unwrap();
    let images = [&render_on_device, &dark];
    exposures.reserve(size).unwrap();
    let (adam, status) = (Adam::new(&gpu).unwrap(), gpu.zeros("status", 1).unwrap());
    for step in 1..=900 {
        let view = step as usize % 3;
        // The gradient of half the mean squared difference.
        gpu.run("expose", |pass| exposures.expose(pass, view, size, images)).unwrap();
        let exposed = gpu.read(exposures.exposed()).unwrap();
        let target =
            |i: usize| truth[view].gain[i / 300] * f64::from(render[i]) + truth[view].bias[i / 300];
        let d: Vec<f32> =
            (0..900).map(|i| ((f64::from(exposed[i]) - target(i)) / 900.0) as f32).collect();
        let mut d_render = gpu.buffer("d_render", &d).unwrap();
        gpu.run("learn", |pass| {
            exposures.backward(pass, view, size, images, &mut d_render)?;
            adam.update(pass, step, 1.0, &mut exposures, &status)?;
            exposures.center(pass, &status)
        })
        .unwrap();
    }
    for (found, truth) in exposures.affines().unwrap().iter().zip(&truth) {
        for c in 0..3 {
            assert!((found.gain[c] - truth.gain[c]).abs() < 0.02, "{found} is not {truth}");
            assert!((found.bias[c] - truth.bias[c]).abs() < 0.02, "{found} is not {truth}");
        }
    }
}

#[test]
fn buffers_and_views_that_do_not_fit_are_refused() {
    let gpu = gpu();
    let new = |start: &[Affine]| Exposures::new(&gpu, ExposureRates::default(), start, &[WHITE; 3]);
    assert!(new(&[]).is_err() && new(&[Affine::IDENTITY; 4]).is_err());
    assert!(new(&[Affine { gain: [1.0, 0.0, 1.0], bias: [0.0; 3] }]).is_err());
    assert!(new(&[Affine { gain: [1.0; 3], bias: [f64::NAN, 0.0, 0.0] }]).is_err());
    let mut exposures = new(&three()).unwrap();
    exposures.reserve(UVec2::splat(8)).unwrap();
    let [mut d_render, render] = [(); 2].map(|()| gpu.zeros("render", 3 * 64).unwrap());
    for (view, size) in [(3, [8, 8]), (0, [0, 8]), (0, [9, 8]), (0, [64, 64])] {
        let images = [&render, &render];
        let exposed = gpu.run("e", |pass| exposures.expose(pass, view, size.into(), images));
        let backward =
            gpu.run("b", |pass| exposures.backward(pass, view, size.into(), images, &mut d_render));
        assert!(exposed.is_err() && backward.is_err(), "{view} {size:?}");
    }
    let short = gpu.zeros("render", 100).unwrap();
    for images in [[&short, &render], [&render, &short]] {
        assert!(gpu.run("e", |pass| exposures.expose(pass, 0, UVec2::splat(8), images)).is_err());
    }
}
