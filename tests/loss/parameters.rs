//! The terms on parameters.

use nightsplat_models::attributes::{Attribute, PlaneCounts, column_count};

use nightsplat::gpu::Buffer;
use nightsplat::kernels::parameter_terms;
use nightsplat::loss::{ParameterTerms, ParameterWeights, Term};
use nightsplat::reference::parameter_terms::parameter_terms;
use nightsplat::splats::batches::Batches;
use nightsplat::splats::device::GaussianSlice;

use super::{assert_close, central_differences, log_step};
use crate::common::prelude::*;

/// Planes of Gaussians of SH degree 0 without features.
fn planes(count: usize) -> Vec<f32> {
    let stream = Stream::new(3, 1);
    let value = |i: usize| 4.0 * stream.uniform(i as u64) as f32 - 2.0;
    (0..count * column_count(0, 0)).map(value).collect()
}

fn gaussians(count: usize, parameters: &Buffer<f32>) -> GaussianSlice<'_> {
    let layout = Layout::new(count, 0, StorageFormat::Single);
    GaussianSlice { layout, parameters: parameters.slice() }
}

#[test]
fn the_kernel_matches_its_reference_and_keeps_other_gradients() {
    for count in [1, 7, 64, 65, 1000] {
        for [opacity_scale, log_scale_scale, ratio_scale] in
            [[0.3, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.4], [0.1, 0.05, 0.02]]
        {
            let parameters = planes(count);
            let before: Vec<f32> = parameters.iter().map(|x| 0.01 * x).collect();
            let gradients = before.clone();
            let [opacity_partials, scale_partials, ratio_partials] =
                [(); 3].map(|()| vec![f32::NAN; count]);
            let constants = parameter_terms::Constants::default();
            let each = gpu().properties().subgroup_size * constants.gaussians_per_thread;
            let (gradients, ..) = run_kernel!(
                parameter_terms,
                constants,
                parameter_terms::Params {
                    gaussian_count: count as u32,
                    opacity_scale,
                    log_scale_scale,
                    ratio_scale,
                    log_ratio: 1.0,
                },
                Threads::Workgroups([(count as u32).div_ceil(each), 1, 1]),
                [parameters],
                [gradients, opacity_partials, scale_partials, ratio_partials]
            );
            let [scales, opacities, dc] =
                [Attribute::LogScales, Attribute::RawOpacities, Attribute::Dc]
                    .map(|attribute| attribute.column(0) * count);
            for (i, (after, before)) in gradients.iter().zip(&before).enumerate() {
                let is_scale = (scales..opacities).contains(&i);
                let is_opacity = (opacities..dc).contains(&i) && opacity_scale > 0.0;
                let grows = is_opacity || is_scale && log_scale_scale > 0.0;
                if ratio_scale == 0.0 || !is_scale {
                    assert_eq!(after > before, grows, "{i} of {count}");
                }
            }
        }
    }
}

#[test]
fn the_gradient_agrees_with_finite_differences() {
    let count = 5;
    let planes: Vec<f64> = planes(count).into_iter().map(f64::from).collect();
    for weights in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.3, 0.7, 0.2]] {
        let value = |planes: &[f64]| parameter_terms(planes, count, weights, 0.5).0;
        let (_, gradient) = parameter_terms(&planes, count, weights, 0.5);
        let numeric = central_differences(&planes, value);
        for (analytic, numeric) in gradient.iter().zip(numeric) {
            assert!((analytic - numeric).abs() < 1e-8, "{analytic} {numeric}");
        }
    }
}

#[test]
fn the_means_over_the_gaussians_reach_the_log_and_their_gradients_the_planes() {
    let (gpu, count) = (gpu(), 741);
    let weights = ParameterWeights {
        opacity_weight: 0.3,
        scale_weight: 0.7,
        anisotropy_weight: 0.2,
        anisotropy_limit: 2.0,
    };
    let mut terms = ParameterTerms::new(&gpu, weights, 0).unwrap().unwrap();
    let (planes, words) = (planes(count), column_count(0, 0));
    let batches = Batches::new(&gpu, PlaneCounts { gaussians: count, columns: words, features: 0 });
    let parameters = batches.upload(&gpu, "parameters", &planes).unwrap();
    let mut gradients = batches.zeros(&gpu, "gradients").unwrap();
    let logged = log_step(&gpu, |pass, log| {
        terms.record(pass, gaussians(count, &parameters), &mut gradients, log)
    })
    .unwrap();
    let planes: Vec<f64> = planes.into_iter().map(f64::from).collect();
    let log_ratio = weights.anisotropy_limit.ln();
    let [opacity, scale, anisotropy] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        .map(|of| parameter_terms(&planes, count, of, log_ratio).0);
    let expected = [(Term::OPACITY, opacity), (Term::SCALE, scale), (Term::ANISOTROPY, anisotropy)];
    for (term, expected) in expected {
        let found = f64::from(logged.losses.get(term));
        assert!((found / expected - 1.0).abs() < 1e-5, "{term:?}: {found}, not {expected}");
    }
    let all = [weights.opacity_weight, weights.scale_weight, weights.anisotropy_weight];
    let (_, expected) = parameter_terms(&planes, count, all, log_ratio);
    let expected: Vec<f32> = expected.into_iter().map(|value| value as f32).collect();
    assert_close("gradients", &batches.read(&gpu, &gradients).unwrap(), &expected, 1e-8);
}

#[test]
fn frozen_attributes_have_no_gradient() {
    let (gpu, count, words) = (gpu(), 739, column_count(0, 0));
    let weights = ParameterWeights {
        opacity_weight: 0.3,
        scale_weight: 0.7,
        anisotropy_weight: 0.2,
        anisotropy_limit: 2.0,
    };
    let whole = Batches::new(&gpu, PlaneCounts { gaussians: count, columns: words, features: 0 });
    let parameters = whole.upload(&gpu, "parameters", &planes(count)).unwrap();
    let gradients = |frozen_columns: u32| {
        let mut terms = ParameterTerms::new(&gpu, weights, frozen_columns).unwrap().unwrap();
        let batches = &whole.without(frozen_columns);
        let mut gradients = batches.zeros(&gpu, "gradients").unwrap();
        let (logged, report) = gpu.checked(|| {
            log_step(&gpu, |pass, log| {
                terms.record(pass, gaussians(count, &parameters), &mut gradients, log)
            })
        });
        report.agree().unwrap();
        (logged.unwrap().losses, batches.read(&gpu, &gradients).unwrap())
    };
    let (losses, all) = gradients(0);
    // The means are those of all Gaussians, frozen or not.
    for (attribute, frozen_columns) in [(Attribute::RawOpacities, 10), (Attribute::Dc, 11)] {
        let (losses_with_frozen, trained) = gradients(frozen_columns);
        assert_eq!(losses_with_frozen, losses);
        let first = attribute.column(0) * count;
        assert!(trained[..first].iter().all(|gradient| *gradient == 0.0));
        assert!(trained[first..] == all[first..]);
    }
}

#[test]
fn a_term_of_weight_0_is_off() {
    assert!(ParameterTerms::new(&gpu(), ParameterWeights::default(), 0).unwrap().is_none());
}

#[test]
fn only_a_ratio_above_the_limit_has_a_loss_and_its_gradient_does_not_grow_with_it() {
    let (count, columns) = (2, column_count(0, 0));
    let first = Attribute::LogScales.column(0) * count;
    for (stretch, value) in [(0.0, 0.0), (0.9, 0.0), (1.5, 0.25), (61.0, 30.0)] {
        let mut planes = vec![0.0; count * columns];
        planes[first + 1] = stretch;
        let (found, gradient) = parameter_terms(&planes, count, [0.0, 0.0, 1.0], 1.0);
        assert_eq!(found, value);
        assert_eq!(gradient[first + 1], if value > 0.0 { 0.5 } else { 0.0 });
        assert_eq!(gradient.iter().sum::<f64>(), 0.0);
    }
}
