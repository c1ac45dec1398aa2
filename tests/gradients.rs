//! The backward pass: central differences of the references, the kernels against the references, the same bits always.

use glam::{DVec2, DVec3, UVec2};
use nightsplat::gpu::testing::assert_no_validation_messages;
use nightsplat::kernels::{ProjectedSplat, blend_backward, project_backward, reduce_records};
use nightsplat::reference::blend_backward::blend_pixel_backward;
use nightsplat::reference::blend_forward::blend_pixel;
use nightsplat::reference::gaussian::{Gaussian, Planes};
use nightsplat::reference::project::{Projection, project_gaussian};
use nightsplat::reference::project_backward::{DSplat, project_gaussian_backward};
use nightsplat::reference::splat::Splat;

#[macro_use]
mod common;
use common::model::{ROUNDING, model_tile, tile_list};
use common::{Frame, Gradients, Random, Setup, assert_close, backward, forward};

/// The whole chain of references in f64: every splat on every pixel, front to back.
struct Chain {
    setup: Setup,
    /// (3, H, W): the functional whose gradient is taken is its product with the render.
    d_render: Vec<f64>,
}

/// The splats of a render, front to back, with the Gaussians they come from.
struct Projected {
    ids: Vec<usize>,
    splats: Vec<Splat>,
    colors: Vec<f64>,
}

impl Chain {
    fn new(setup: Setup) -> Self {
        let mut random = Random::new(4);
        let d_render = (0..setup.channels as usize * setup.pixels())
            .map(|_| random.between(-1.0, 1.0))
            .collect();
        Self { setup, d_render }
    }

    fn project(&self, parameters: &[f64]) -> Projected {
        let (camera, params) = (self.setup.camera(), &self.setup.params);
        let one = |i| -> Option<(usize, Projection, Vec<f64>)> {
            let gaussian = self.setup.planes().load(parameters, i);
            let (near, raw_colors) = (params.near.into(), self.setup.raw_colors);
            let projection =
                project_gaussian(&camera, near, params.sh_degree, raw_colors, &gaussian)?;
            Some((i, projection, gaussian.features))
        };
        let mut visible: Vec<_> = (0..self.setup.planes().count).filter_map(one).collect();
        visible.sort_by(|(_, a, _), (_, b, _)| a.depth.total_cmp(&b.depth));
        Projected {
            ids: visible.iter().map(|(i, ..)| *i).collect(),
            splats: visible.iter().map(|(_, p, _)| p.splat).collect(),
            colors: visible
                .iter()
                .flat_map(|(_, p, features)| [&p.color.to_array()[..], features].concat())
                .collect(),
        }
    }

    /// Centre and gradient of each pixel.
    fn pixels(&self) -> impl Iterator<Item = (DVec2, Vec<f64>)> {
        let (width, count) = (self.setup.params.camera.size.x as usize, self.setup.pixels());
        (0..count).map(move |at| {
            let center = DVec2::new((at % width) as f64, (at / width) as f64) + 0.5;
            (center, (0..self.channels()).map(|c| self.d_render[c * count + at]).collect())
        })
    }

    fn loss(&self, parameters: &[f64], background: &[f64]) -> f64 {
        let Projected { splats, colors, .. } = self.project(parameters);
        let pixel = |(center, d): (DVec2, Vec<f64>)| {
            let (render, _) = blend_pixel(&splats, &colors, background, center, self.alpha_max());
            render.iter().zip(d).map(|(value, d)| value * d).sum::<f64>()
        };
        self.pixels().map(pixel).sum()
    }

    fn channels(&self) -> usize {
        self.setup.channels as usize
    }

    fn alpha_max(&self) -> f64 {
        self.setup.alpha_max.into()
    }

    /// The gradients of parameters and background that the references' own backward gives.
    fn gradient(&self, parameters: &[f64], background: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let Projected { ids, splats, colors } = self.project(parameters);
        let (channels, record) = (self.channels(), self.setup.record());
        let (mut records, mut d_background) = (vec![0.0; record * ids.len()], vec![0.0; channels]);
        for (center, d) in self.pixels() {
            let (render, transmittance) =
                blend_pixel(&splats, &colors, background, center, self.alpha_max());
            blend_pixel_backward(
                &splats,
                &colors,
                &render,
                &d,
                center,
                self.alpha_max(),
                &mut records,
            );
            (0..channels).for_each(|c| d_background[c] += transmittance * d[c]);
        }
        let planes = self.setup.planes();
        let mut gradient = vec![0.0; planes.len()];
        for (j, &i) in ids.iter().enumerate() {
            let d_splat =
                d_splat(&self.setup, &records[record * j..][..record], &colors[channels * j..]);
            let gaussian = planes.load(parameters, i);
            let d = project_gaussian_backward(
                &self.setup.camera(),
                self.setup.params.sh_degree,
                &gaussian,
                &splats[j],
                &d_splat,
            );
            planes.store(&d, i, |at, value| gradient[at] = value);
        }
        (gradient, d_background)
    }

    /// Compares central differences with the references' gradient, relative to the largest of each attribute.
    fn check(&self, name: &str) {
        let parameters: Vec<f64> = self.setup.parameters.iter().map(|&p| p.into()).collect();
        let background: Vec<f64> =
            self.setup.background[..self.channels()].iter().map(|&b| b.into()).collect();
        let (gradient, d_background) = self.gradient(&parameters, &background);
        let difference = |values: &[f64], at: usize, loss: &dyn Fn(&[f64]) -> f64| {
            let step = 1e-5;
            let moved = |by: f64| {
                let mut values = values.to_vec();
                values[at] += by;
                loss(&values)
            };
            (moved(step) - moved(-step)) / (2.0 * step)
        };
        let count = self.setup.planes().count;
        let rest = 14 + self.setup.planes().feature_count;
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
            assert!(
                largest > 1e-3 || range.is_empty(),
                "{name}: no gradient of {attribute} to speak of"
            );
            for at in range {
                let expected = difference(&parameters, at, &|p| self.loss(p, &background));
                // The second term is the rounding of the loss, over the step.
                let bound = 1e-6 * largest + 1e-9;
                let error = (gradient[at] - expected).abs();
                assert!(
                    error < bound,
                    "{name}: {attribute} [{at}] {} is not {expected}",
                    gradient[at]
                );
            }
        }
        for (c, &actual) in d_background.iter().enumerate() {
            let expected = difference(&background, c, &|b| self.loss(&parameters, b));
            assert!((actual - expected).abs() < 1e-6 * expected.abs(), "{name}: background");
        }
    }
}

/// What arrives at a splat, where clamped colours pass nothing on.
fn d_splat(setup: &Setup, record: &[f64], color: &[f64]) -> DSplat {
    let is_free = |c: usize| setup.raw_colors || color[c] > 0.0;
    let passes = |c: usize| if is_free(c) { record[6 + c] } else { 0.0 };
    DSplat {
        mean2d: DVec2::from_slice(record),
        conic: DVec3::from_slice(&record[2..]),
        opacity: record[5],
        color: DVec3::from_array([0, 1, 2].map(passes)),
        features: record[9..].to_vec(),
    }
}

#[test]
fn the_references_gradients_are_their_central_differences() {
    let size = UVec2::new(26, 19);
    for (stored, used) in [(0, 0), (1, 1), (2, 2), (3, 3)] {
        let mut setup = Setup::new(7, size, stored, 21 + u64::from(stored));
        setup.params.sh_degree = used;
        Chain::new(setup).check(&format!("SH degree {stored}"));
    }
}

#[test]
fn every_feature_and_every_raw_color_has_its_central_difference() {
    for (channels, raw_colors) in [(5, false), (11, true)] {
        let setup = Setup::with_channels(7, UVec2::new(26, 19), 1, channels, 61);
        Chain::new(Setup { raw_colors, ..setup }).check(&format!("{channels} channels"));
    }
}

#[test]
fn coefficients_above_the_degree_in_use_have_no_gradient() {
    let mut setup = Setup::new(7, UVec2::new(26, 19), 3, 31);
    setup.params.sh_degree = 1;
    let chain = Chain::new(setup);
    chain.check("SH degree 1 of 3");
    let parameters: Vec<f64> = chain.setup.parameters.iter().map(|&p| p.into()).collect();
    let (gradient, _) = chain.gradient(&parameters, &[0.0; 3]);
    let above = (0..7).flat_map(|i| chain.setup.planes().load(&gradient, i).sh.split_off(4));
    assert!(above.into_iter().all(|coefficient| coefficient == DVec3::ZERO));
}

#[test]
fn the_gradient_holds_where_the_slope_is_clamped() {
    let mut setup = Setup::new(5, UVec2::new(26, 19), 1, 41);
    let camera = setup.camera();
    for (i, beyond) in [
        (0, DVec2::new(1.3, 0.5)),
        (1, DVec2::new(-0.4, 0.4)),
        (2, DVec2::new(0.5, 1.5)),
        (3, DVec2::new(1.3, -0.3)),
    ] {
        let depth = 2.0 + 0.3 * i as f64;
        let pixel = beyond * camera.size;
        let in_view = ((pixel - camera.principal_point) / camera.focal * depth).extend(depth);
        let slope = in_view.truncate() / depth;
        assert_ne!(camera.clamped_slope(in_view), slope, "not clamped");
        let mean = camera.rotation.transpose() * (in_view - camera.translation);
        let log_scale = DVec3::new(-0.3, -0.6, -0.1);
        setup.set(i, &Gaussian { mean, log_scale, raw_opacity: 1.0, ..setup.get(i) });
    }
    Chain::new(setup).check("clamped slope");
}

#[test]
fn the_gradient_holds_through_capped_alphas_and_done_pixels() {
    let mut setup = Setup::new(12, UVec2::new(16, 12), 1, 51);
    for i in 0..12 {
        let gaussian = setup.get(i);
        let log_scale = gaussian.log_scale + 1.2;
        setup.set(i, &Gaussian { raw_opacity: 2.0 + 0.5 * i as f64, log_scale, ..gaussian });
    }
    let chain = Chain::new(setup);
    let parameters: Vec<f64> = chain.setup.parameters.iter().map(|&p| p.into()).collect();
    let Projected { splats, colors, .. } = chain.project(&parameters);
    let last = |(center, _)| blend_pixel(&splats, &colors, &[0.0; 3], center, 0.99).1;
    assert!(
        chain.pixels().map(last).any(|transmittance| transmittance < 5e-4),
        "nothing is opaque"
    );
    chain.check("opaque");
}

/// Scenes for the kernels, with a gradient of the render that avoids pixels where a rounding decides.
fn gpu_scenes() -> Vec<(Setup, Frame, Vec<f32>)> {
    let build = |setup: Setup| {
        let frame = forward(&setup, None);
        let mut random = Random::new(3);
        let mut d_render: Vec<f32> =
            frame.render.iter().map(|_| random.between(-1.0, 1.0) as f32).collect();
        for pixel in (0..frame.tile_ranges.len()).flat_map(|tile| model_tile(&setup, &frame, tile))
        {
            if pixel.is_fragile {
                (pixel.at..d_render.len())
                    .step_by(setup.pixels())
                    .for_each(|at| d_render[at] = 0.0);
            }
        }
        (setup, frame, d_render)
    };
    common::variants().into_iter().map(build).collect()
}

#[test]
fn blend_backward_and_its_reduction_match_the_references() {
    for (setup, frame, d_render) in gpu_scenes() {
        let actual = backward(&setup, &frame, &d_render);
        let Frame { tile_ranges, sorted_slots, owners, splats, colors, render, .. } = &frame;
        let Frame { counts, sorted_ids, ordered_counts, offsets, .. } = &frame;
        let records = vec![f32::NAN; actual.records.len()];
        let records = run_reference!(
            blend_backward,
            constants!(blend_backward, setup),
            blend_backward::Params {
                size: setup.params.camera.size,
                tile_columns: setup.tiles().x
            },
            [tile_ranges, sorted_slots, owners, splats, colors, render, d_render],
            [records]
        );
        let bounds = record_bounds(&setup, &frame, &d_render);
        assert_close("records", &actual.records, &records, |i, _| bounds[i] as f32);

        // Sums in one order round alike.
        let records = &actual.records;
        let d_splats = vec![f32::NAN; actual.d_splats.len()];
        let d_splats = run_reference!(
            reduce_records,
            constants!(reduce_records, setup),
            reduce_records::Params { gaussian_count: setup.params.gaussian_count },
            [counts, sorted_ids, ordered_counts, offsets, records],
            [d_splats]
        );
        assert_eq!(actual.d_splats, d_splats);
    }
    assert_no_validation_messages();
}

/// The rounding model of `blend_backward`: the light still to come is off by what the render may be off, which
/// 1 / (1 - alpha) magnifies; the rest is relative to the magnitude of each pixel's share.
fn record_bounds(setup: &Setup, frame: &Frame, d_render: &[f32]) -> Vec<f64> {
    let (channels, record) = (setup.channels as usize, setup.record());
    let mut bounds = vec![0.0; record * frame.owners.len()];
    for (tile, range) in frame.tile_ranges.iter().enumerate() {
        let slots = &frame.sorted_slots[range.x as usize..range.y as usize];
        let (splats, colors) = tile_list(setup, frame, tile);
        for pixel in model_tile(setup, frame, tile) {
            let d = |c: usize| f64::from(d_render[c * setup.pixels() + pixel.at].abs());
            let d_sum: f64 = (0..channels).map(d).sum();
            let light: f64 = (0..channels)
                .map(|c| f64::from(frame.render[c * setup.pixels() + pixel.at].abs()) * d(c))
                .sum();
            for (fragment, &alpha_error) in pixel.fragments.iter().zip(&pixel.alpha_errors) {
                let Splat { conic, .. } = splats[fragment.index];
                let bound = &mut bounds[record * slots[fragment.index] as usize..][..record];
                let color = &colors[channels * fragment.index..][..channels];
                let size: f64 = light
                    + (0..channels).map(|c| fragment.before * color[c].abs() * d(c)).sum::<f64>();
                let relative = 2.0 * alpha_error / (1.0 - fragment.alpha) + 300.0 * ROUNDING;
                let d_alpha =
                    (2.0 * pixel.error * d_sum + relative * size) / (1.0 - fragment.alpha);
                let (d_sigma, x, y) =
                    (fragment.alpha * d_alpha, fragment.d.x.abs(), fragment.d.y.abs());
                bound[0] += d_sigma * (conic.x * x + conic.y.abs() * y);
                bound[1] += d_sigma * (conic.y.abs() * x + conic.z * y);
                bound[2] += d_sigma * 0.5 * x * x;
                bound[3] += d_sigma * x * y;
                bound[4] += d_sigma * 0.5 * y * y;
                bound[5] += d_alpha * fragment.falloff;
                let weight = fragment.alpha * fragment.before;
                (0..channels)
                    .for_each(|c| bound[6 + c] += weight * (relative + pixel.error) * d(c));
            }
        }
    }
    bounds
}

#[test]
fn project_backward_matches_the_reference() {
    for (setup, frame, d_render) in gpu_scenes() {
        let actual = backward(&setup, &frame, &d_render);
        let Frame { splats, colors, tile_counts, status, .. } = &frame;
        let Gradients { d_splats, .. } = &actual;
        let Setup { parameters, .. } = &setup;
        let n = setup.params.gaussian_count as usize;
        let gradients = vec![f32::NAN; actual.gradients.len()];
        let (grad_norm_sums, visit_counts) = (vec![0.5; n], vec![3; n]);
        let (gradients, grad_norm_sums, visit_counts) = run_reference!(
            project_backward,
            constants!(project_backward, setup, sh_degree, raw_colors),
            common::project_backward_params(&setup),
            [parameters, splats, colors, tile_counts, d_splats, status],
            [gradients, grad_norm_sums, visit_counts]
        );
        let bounds = gradient_bounds(&setup, &frame, d_splats);
        assert_close("gradients", &actual.gradients, &gradients, |i, _| bounds[i] as f32);
        let relative = 64.0 * ROUNDING as f32;
        assert_close("norms", &actual.grad_norm_sums, &grad_norm_sums, |_, norm| relative * norm);
        assert_eq!(actual.visit_counts, visit_counts);
    }
    assert_no_validation_messages();
}

/// Backward stability: the kernel gives what the reference gives for inputs that are off by some roundings each.
fn gradient_bounds(setup: &Setup, frame: &Frame, d_splats: &[f32]) -> Vec<f64> {
    let planes = setup.planes();
    let mut bounds = vec![0.0; planes.len()];
    let off = 256.0 * ROUNDING;
    for i in (0..planes.count).filter(|&i| frame.tile_counts[i] > 0) {
        let color: Vec<f64> =
            frame.colors[setup.channels as usize * i..][..3].iter().map(|&c| c.into()).collect();
        let record: Vec<f64> =
            d_splats[setup.record() * i..][..setup.record()].iter().map(|&d| d.into()).collect();
        let one = Planes { count: 1, ..planes };
        let mut inputs = vec![0.0; one.len()];
        one.store(&setup.get(i), 0, |at, value| inputs[at] = value);
        let gaussian_len = inputs.len();
        inputs.extend(frame.splats[i].conic.to_array().map(f64::from));
        inputs.extend(&record);
        let gradient = |inputs: &[f64]| {
            let (gaussian, splat) = inputs.split_at(gaussian_len);
            let projected = Splat {
                conic: DVec3::from_slice(splat),
                ..Splat::from(&ProjectedSplat::default())
            };
            let d_splat = d_splat(setup, &splat[3..], &color);
            let gaussian = one.load(gaussian, 0);
            let degree = setup.params.sh_degree;
            let d =
                project_gaussian_backward(&setup.camera(), degree, &gaussian, &projected, &d_splat);
            let mut values = vec![0.0; gaussian_len];
            one.store(&d, 0, |at, value| values[at] = value);
            values
        };
        let exact = gradient(&inputs);
        let mut bound: Vec<f64> = exact.iter().map(|g| off * g.abs()).collect();
        for at in 0..inputs.len() {
            let mut moved = inputs.clone();
            // Means and log scales also pass through sums and exponentials with terms of order one.
            moved[at] += off * (inputs[at].abs() + if at < gaussian_len { 1.0 } else { 0.0 });
            bound
                .iter_mut()
                .zip(gradient(&moved))
                .zip(&exact)
                .for_each(|((b, m), e)| *b += (m - e).abs());
        }
        planes.store(&one.load(&bound, 0), i, |at, value| bounds[at] = value);
    }
    bounds
}

#[test]
fn an_overflow_leaves_no_gradient_and_no_statistics() {
    let setup = Setup::new(65, UVec2::new(50, 40), 1, 5);
    let frame = forward(&setup, Some(3));
    let gradients = backward(&setup, &frame, &vec![1.0; frame.render.len()]);
    assert!(gradients.gradients.iter().chain(&gradients.d_splats).all(|&d| d == 0.0));
    assert_eq!((gradients.grad_norm_sums, gradients.visit_counts), (vec![0.5; 65], vec![3; 65]));
}

#[test]
fn the_same_frame_gives_the_same_bits_every_time() {
    let tile = UVec2::new(16, 8);
    let setup = Setup { tile, ..Setup::with_channels(777, UVec2::new(131, 77), 2, 4, 8) };
    let frame = forward(&setup, None);
    let d_render: Vec<f32> =
        (0..frame.render.len()).map(|i| ((i % 17) as f32 - 8.0) / 8.0).collect();
    let bits = |gradients: Gradients| -> Vec<u32> {
        let Gradients { records, d_splats, gradients, grad_norm_sums, visit_counts } = gradients;
        let floats = records.into_iter().chain(d_splats).chain(gradients).chain(grad_norm_sums);
        floats.map(f32::to_bits).chain(visit_counts).collect()
    };
    let first = bits(backward(&setup, &frame, &d_render));
    for repetition in 1..25 {
        assert_eq!(forward(&setup, None), frame, "repetition {repetition}");
        assert!(bits(backward(&setup, &frame, &d_render)) == first, "repetition {repetition}");
    }
    assert_no_validation_messages();
}
