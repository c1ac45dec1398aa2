//! The terms on parameters.

use nightsplat::attributes::{Attribute, column_count};
use nightsplat::gpu::Threads;
use nightsplat::gpu::testing::gpu;
use nightsplat::kernels::parameter_terms;
use nightsplat::loss::{ParameterInputs, ParameterTerms, ParameterWeights, Term};
use nightsplat::random::Stream;
use nightsplat::reference::parameter_terms::parameter_terms;

use super::{assert_close, central_differences, log_step};

/// Planes of Gaussians of SH degree 0 without features.
fn planes(count: usize) -> Vec<f32> {
    let stream = Stream::new(3, 1);
    let value = |i: usize| 4.0 * stream.uniform(i as u64) as f32 - 2.0;
    (0..count * column_count(0, 0)).map(value).collect()
}

#[test]
fn the_kernel_matches_its_reference_and_leaves_other_gradients() {
    for count in [1, 7, 64, 65, 1000] {
        for [opacity_scale, log_scale_scale] in [[0.3, 0.0], [0.0, 0.2], [0.1, 0.05]] {
            let parameters = planes(count);
            let before: Vec<f32> = parameters.iter().map(|x| 0.01 * x).collect();
            let gradients = before.clone();
            let [opacity_partials, scale_partials] = [(); 2].map(|()| vec![f32::NAN; count]);
            let constants = parameter_terms::Constants::default();
            let each = gpu().properties().subgroup_size * constants.gaussians_per_thread;
            let (gradients, ..) = run_kernel!(
                parameter_terms,
                constants,
                parameter_terms::Params {
                    gaussian_count: count as u32,
                    opacity_scale,
                    log_scale_scale
                },
                Threads::Workgroups([(count as u32).div_ceil(each), 1, 1]),
                [parameters],
                [gradients, opacity_partials, scale_partials]
            );
            let [scales, opacities, dc] =
                [Attribute::LogScales, Attribute::RawOpacities, Attribute::Dc]
                    .map(|attribute| attribute.column(0) * count);
            for (i, (after, before)) in gradients.iter().zip(&before).enumerate() {
                let is_scale = (scales..opacities).contains(&i) && log_scale_scale > 0.0;
                let is_opacity = (opacities..dc).contains(&i) && opacity_scale > 0.0;
                assert_eq!(after > before, is_scale || is_opacity, "{i} of {count}");
            }
        }
    }
}

#[test]
fn the_gradient_is_that_of_finite_differences() {
    let count = 5;
    let planes: Vec<f64> = planes(count).into_iter().map(f64::from).collect();
    for weights in [[1.0, 0.0], [0.0, 1.0], [0.3, 0.7]] {
        let (_, gradient) = parameter_terms(&planes, count, weights);
        let numeric =
            central_differences(&planes, |planes| parameter_terms(planes, count, weights).0);
        for (analytic, numeric) in gradient.iter().zip(numeric) {
            assert!((analytic - numeric).abs() < 1e-8, "{analytic} {numeric}");
        }
    }
}

#[test]
fn two_batches_log_the_means_of_all_gaussians() {
    let gpu = gpu();
    let weights = ParameterWeights { opacity_weight: 0.3, scale_weight: 0.7 };
    let mut terms = ParameterTerms::new(&gpu, weights).unwrap().unwrap();
    let (counts, all_count) = ([700_usize, 41], 741);
    let parts = counts.map(planes);
    let buffers = parts.each_ref().map(|part| gpu.buffer("parameters", part).unwrap());
    let mut gradients = parts.each_ref().map(|part| gpu.zeros("gradients", part.len()).unwrap());
    let logged = log_step(&gpu, |pass, log| {
        let batches = counts.into_iter().zip(&buffers).zip(&mut gradients);
        let batches = batches.map(|((count, parameters), gradients)| {
            let gaussian_count = count as u32;
            (ParameterInputs { gaussian_count, all_count, parameters }, gradients)
        });
        terms.record(pass, &mut batches.collect::<Vec<_>>(), log)
    })
    .unwrap();
    let [mut opacity, mut scale] = [0.0; 2];
    for ((count, part), gradients) in counts.into_iter().zip(&parts).zip(&gradients) {
        let part: Vec<f64> = part.iter().copied().map(f64::from).collect();
        let share = count as f64 / f64::from(all_count);
        opacity += share * parameter_terms(&part, count, [1.0, 0.0]).0;
        scale += share * parameter_terms(&part, count, [0.0, 1.0]).0;
        let weights = [weights.opacity_weight, weights.scale_weight].map(|weight| weight * share);
        let (_, expected) = parameter_terms(&part, count, weights);
        let expected: Vec<f32> = expected.into_iter().map(|value| value as f32).collect();
        assert_close("gradients", &gpu.read(gradients).unwrap(), &expected, 1e-8);
    }
    for (term, expected) in [(Term::OPACITY, opacity), (Term::SCALE, scale)] {
        let found = f64::from(logged.losses.get(term));
        assert!((found / expected - 1.0).abs() < 1e-5, "{term:?}: {found}, not {expected}");
    }
}

#[test]
fn a_weight_of_0_has_no_term() {
    assert!(ParameterTerms::new(&gpu(), ParameterWeights::default()).unwrap().is_none());
}
