//! The terms on parameters.

use nightsplat::base::random::Stream;
use nightsplat::gpu::Threads;
use nightsplat::gpu::testing::gpu;
use nightsplat::kernels::parameter_terms;
use nightsplat::loss::{ParameterInputs, ParameterTerms, ParameterWeights, Term};
use nightsplat::reference::parameter_terms::parameter_terms;
use nightsplat::splats::attributes::{Attribute, PlaneCounts, column_count};
use nightsplat::splats::batches::Batches;

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
fn the_means_over_the_gaussians_reach_the_log_and_their_gradients_the_planes() {
    let (gpu, count) = (gpu(), 741);
    let weights = ParameterWeights { opacity_weight: 0.3, scale_weight: 0.7 };
    let mut terms = ParameterTerms::new(&gpu, weights).unwrap().unwrap();
    let (planes, words) = (planes(count), column_count(0, 0));
    let batches = Batches::new(&gpu, PlaneCounts { gaussians: count, columns: words, features: 0 });
    let parameters = batches.upload(&gpu, "parameters", &planes).unwrap();
    let mut gradients = batches.zeros(&gpu, "gradients").unwrap();
    let logged = log_step(&gpu, |pass, log| {
        let inputs = ParameterInputs { batches: &batches, words, parameters: &parameters };
        terms.record(pass, inputs, &mut gradients, log)
    })
    .unwrap();
    let planes: Vec<f64> = planes.into_iter().map(f64::from).collect();
    let [opacity, scale] = [[1.0, 0.0], [0.0, 1.0]].map(|of| parameter_terms(&planes, count, of).0);
    for (term, expected) in [(Term::OPACITY, opacity), (Term::SCALE, scale)] {
        let found = f64::from(logged.losses.get(term));
        assert!((found / expected - 1.0).abs() < 1e-5, "{term:?}: {found}, not {expected}");
    }
    let of_both = [weights.opacity_weight, weights.scale_weight];
    let (_, expected) = parameter_terms(&planes, count, of_both);
    let expected: Vec<f32> = expected.into_iter().map(|value| value as f32).collect();
    assert_close("gradients", &batches.read(&gpu, &gradients).unwrap(), &expected, 1e-8);
}

#[test]
fn a_weight_of_0_has_no_term() {
    assert!(ParameterTerms::new(&gpu(), ParameterWeights::default()).unwrap().is_none());
}
