//! How errors grow: blending with its layers, Adam with its steps; each against f64, with the promised bound.

use std::ops::Range;

use nightsplat::kernels::log_scale::{LOG_SCALE_MAX, LOG_SCALE_MIN};
use nightsplat::reference::blend_backward::blend_pixel_backward;
use nightsplat::reference::blend_forward::blend_pixel;
use nightsplat::reference::rounding::UNIT;
use nightsplat::reference::splat::Splat;
use nightsplat::splats::optimizer::{Adam, AdamBuffers, AdamStep, LearningRates};
use nightsplat_models::attributes::{AttributePlane, PlaneCounts, planes};

use crate::common::prelude::*;
use crate::common::widen;

/// Numbers in a record of three channels: six moments, the sum of magnitudes, colour.
const RECORD: usize = 10;
/// The same as stored, with zeros.
const STORED_RECORD: usize = 12;

/// The opacity of `count` layers that together let a fiftieth of the light through; above 1/255 everywhere in the view.
fn opacity_of(count: usize) -> f64 {
    (1.0 - (-4.0 / count as f64).exp()).max(0.0055)
}

/// `count` layers over a view of one tile, front to back.
fn layers(count: usize) -> Setup {
    let mut setup = Setup::new(count, [16, 8], 0, 7);
    setup.settings.tile = Some([16, 8].into());
    let mut random = Random::new(count as u64);
    let opacity = opacity_of(count);
    for i in 0..count {
        let depth = 1.0 + 4.0 * (i as f64 + 1.0) / count as f64;
        let pixel = DVec2::new(random.between(4.0, 12.0), random.between(2.0, 6.0));
        let gaussian = Gaussian {
            mean: setup.at_pixel(pixel, depth),
            log_scale: DVec3::splat((random.between(14.0, 30.0) * depth / 14.4).ln()),
            raw_opacity: (opacity / (1.0 - opacity)).ln(),
            ..setup.get(i)
        };
        setup.set(i, &gaussian);
    }
    setup
}

/// The largest error of the render relative to the largest colour, and of the records relative to the largest of each
/// number, in roundings.
fn errors_of(count: usize) -> [f64; 2] {
    let setup = layers(count);
    let mut rendered = setup.render();
    let mut random = Random::new(9);
    let d_render: Vec<f32> =
        rendered.render.iter().map(|_| random.between(-1.0, 1.0) as f32).collect();
    rendered.backward(&d_render);
    let frame = rendered.renderer.frame();
    let splats = gpu().read(&frame.splats).unwrap();
    let splats: Vec<Splat> = splats[..count].iter().map(Splat::from).collect();
    let colors = gpu().read(&frame.colors).unwrap();
    let colors: Vec<f32> =
        colors[..4 * count].chunks(4).flat_map(|four| &four[..3]).copied().collect();
    let colors = widen(&colors);
    // The view is one tile, so every layer has one slot.
    let intersection_ids = gpu().read(&frame.lists.intersection_ranges).unwrap();
    let stored = gpu().read(&frame.gradient_records).unwrap();
    let sums: Vec<f32> = intersection_ids[..count]
        .iter()
        .flat_map(|slot| {
            let record = &stored[STORED_RECORD * slot.x as usize..];
            record[..RECORD].to_vec()
        })
        .collect();
    let (pixels, alpha_max) = (setup.pixels(), f64::from(setup.settings.max_alpha));
    let background: Vec<f64> = widen(&setup.background());
    let largest_color = colors.iter().chain(&background).fold(1.0f64, |most, c| most.max(c.abs()));
    let (mut gradient_records, mut forward) = (vec![0.0; RECORD * count], 0.0f64);
    for at in 0..pixels {
        let width = setup.camera.width as usize;
        let center = DVec2::new((at % width) as f64, (at / width) as f64) + 0.5;
        let (values, _) = blend_pixel(&splats, &colors, &background, center, alpha_max);
        let d: Vec<f64> = (0..3).map(|c| d_render[c * pixels + at].into()).collect();
        for (c, value) in values.iter().enumerate() {
            let error = (f64::from(rendered.render[c * pixels + at]) - value).abs();
            forward = forward.max(error / largest_color);
        }
        blend_pixel_backward(
            &splats,
            &colors,
            &values,
            &d,
            center,
            alpha_max,
            |c| c < 3,
            &mut gradient_records,
        );
    }
    let backward = (0..RECORD).map(|k| {
        let norm = |values: &dyn Fn(usize) -> f64| {
            (0..count).map(|i| values(RECORD * i + k).abs()).fold(0.0, f64::max)
        };
        norm(&|at| f64::from(sums[at]) - gradient_records[at]) / norm(&|at| gradient_records[at])
    });
    [forward / UNIT, backward.fold(0.0, f64::max) / UNIT]
}

#[test]
fn the_errors_of_blending_and_its_gradients_grow_at_most_linearly_with_the_layers() {
    for count in [1, 4, 16, 64, 256, 1024, 4096] {
        let [forward, backward] = errors_of(count);
        println!("{count} layers: render {forward:.1}, gradients {backward:.1} roundings");
        let bound = 32.0 + 6.0 * count as f64;
        assert!(forward <= bound, "{count} layers: the render is off by {forward} roundings");
        // The backward pass divides by each layer's transmittance.
        let bound = 4.0 * bound / (1.0 - opacity_of(count));
        assert!(backward <= bound, "{count} layers: gradients are off by {backward} roundings");
    }
}

/// Final rates of a training schedule: of means, quats, log scales, raw opacities, dc, features, rest.
const RATES: LearningRates = LearningRates([1.6e-6, 1e-3, 5e-4, 2.5e-3, 2.5e-3, 1e-3, 1.25e-4]);
const LOG_SCALES: usize = 2;
const COLUMNS: usize = 23;
const GAUSSIANS: usize = 4;
/// Number of distinct gradients, which repeat: noise about a mean.
const TURNS: u64 = 16;

fn gradient(turn: u64, at: usize) -> f32 {
    let stream = Stream::new(5, turn);
    (0.02 + stream.normal(at as u64)) as f32 * 1e-4
}

/// Adam in f64, as published.
fn adam_in_f64(steps: u64, start: &[f32]) -> Vec<f64> {
    let gradients: Vec<Vec<f64>> = (0..TURNS)
        .map(|turn| (0..start.len()).map(|at| gradient(turn, at).into()).collect())
        .collect();
    let planes = planes(0, COLUMNS);
    let plane_of = |at: usize| {
        let column = at / GAUSSIANS;
        planes.iter().rposition(|plane| plane.width > 0 && column >= plane.column).unwrap()
    };
    let in_f64 = |at: usize| {
        let (mut value, mut m, mut v) = (f64::from(start[at]), 0.0, 0.0);
        let plane = plane_of(at);
        let rate = RATES.0[plane];
        for step in 1..=steps {
            let g = gradients[(step % TURNS) as usize][at];
            m = 0.9 * m + 0.1 * g;
            v = 0.999 * v + 0.001 * g * g;
            let power = step.min(100_000) as i32;
            let corrected = (v / (1.0 - 0.999f64.powi(power))).sqrt();
            value -= rate * m / (1.0 - 0.9f64.powi(power)) / (corrected + 1e-15);
            if plane == LOG_SCALES {
                value = value.clamp(LOG_SCALE_MIN, LOG_SCALE_MAX);
            }
        }
        value
    };
    (0..start.len()).map(in_f64).collect()
}

/// The same steps on the device.
fn adam_on_device(steps: u64, start: &[f32]) -> Vec<f32> {
    let gpu = gpu();
    let gradients: Vec<_> = (0..TURNS)
        .map(|turn| {
            let values: Vec<f32> = (0..start.len()).map(|at| gradient(turn, at)).collect();
            gpu.buffer("gradients", &values).unwrap()
        })
        .collect();
    let mut parameters = gpu.buffer("parameters", start).unwrap();
    let mut moments = Moments::zeros(&gpu, start.len()).unwrap();
    let (status, adam) = (gpu.buffer("status", &[0u32]).unwrap(), Adam::new(&gpu).unwrap());
    let mut record = |steps: Range<u64>| {
        gpu.run("adam", |pass| {
            for step in steps.clone() {
                let buffers = AdamBuffers {
                    parameters: parameters.slice_mut(),
                    gradients: gradients[(step % TURNS) as usize].slice(),
                    moments: moments.slice_mut(),
                };
                let planes = PlaneCounts { gaussians: GAUSSIANS, columns: COLUMNS, features: 0 };
                let step = AdamStep { step, rates: &RATES, status: &status };
                adam.record(pass, step, planes, buffers)?;
            }
            Ok(())
        })
        .unwrap();
    };
    for begin in (1..=steps).step_by(1000) {
        record(begin..(begin + 1000).min(steps + 1));
    }
    gpu.read(&parameters).unwrap()
}

/// The errors of a plane, which `assert_adam_stays_with_f64` bounds.
struct PlaneError {
    /// The largest error.
    error: f64,
    /// How far the parameter moved.
    moved: f64,
    /// The largest unit in the last place of the parameter, which moves between its first and its last value.
    unit: f64,
}

fn adam_errors(steps: u64) -> Vec<PlaneError> {
    let start: Vec<f32> =
        (0..GAUSSIANS * COLUMNS).map(|at| 1.5 * (at as f32 * 0.7).sin()).collect();
    let (actual, expected) = (adam_on_device(steps, &start), adam_in_f64(steps, &start));
    let of_plane = |AttributePlane { column, width, .. }| {
        let plane = GAUSSIANS * column..GAUSSIANS * (column + width);
        let most = |of: &dyn Fn(usize) -> f64| plane.clone().map(of).fold(0.0, f64::max);
        let largest = most(&|at| expected[at].abs().max(f64::from(start[at]).abs()));
        PlaneError {
            error: most(&|at| (f64::from(actual[at]) - expected[at]).abs()),
            moved: most(&|at| (expected[at] - f64::from(start[at])).abs()),
            unit: largest.log2().floor().exp2() * f64::from(f32::EPSILON),
        }
    };
    planes(0, COLUMNS).map(of_plane).into()
}

/// A step rounds the parameter once, by up to half a unit in its last place; the step itself is also off by some
/// roundings. The signs of the first errors differ.
fn assert_adam_stays_with_f64(steps: u64) {
    for (plane, PlaneError { error, moved, unit }) in adam_errors(steps).into_iter().enumerate() {
        if moved == 0.0 {
            continue;
        }
        eprintln!(
            "plane {plane}: moved by {moved:.2e}, off by {:.3} units a step",
            error / unit / steps as f64
        );
        let bound = unit * steps as f64 / 2.0 + 1e-4 * moved;
        assert!(error <= bound, "plane {plane}: off by {error:e} after moving by {moved:e}");
    }
}

#[test]
fn adam_stays_with_f64_over_thousands_of_steps() {
    assert_adam_stays_with_f64(10_000);
}

#[test]
#[ignore = "takes a minute: part of `make stress`"]
fn adam_stays_with_f64_over_a_hundred_thousand_steps() {
    assert_adam_stays_with_f64(100_000);
}
