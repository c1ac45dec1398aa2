use super::rounding::UNIT;
use crate::attributes::{Attribute, planes};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::densify_count::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::fate::{FATE_CLONE, FATE_KEEP, FATE_PRUNE, FATE_SPLIT};

fn mean_gradient(slices: &Slices<'_>, i: usize) -> f32 {
    match slices.visit_counts[i] {
        0 => 0.0,
        visits => slices.grad_norm_sums[i] / visits as f32,
    }
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let n = params.gaussian_count as usize;
        let first = |attribute: Attribute| attribute.column(0) * n;
        let (opacities, log_scales) = (first(Attribute::RawOpacities), first(Attribute::LogScales));
        for i in 0..n {
            let [features, columns] =
                [params.feature_count, params.column_count].map(|n| n as usize);
            let is_finite = planes(features, columns).iter().all(|(column, width)| {
                (0..*width).all(|k| slices.parameters[column * n + width * i + k].abs() < 3e38)
            });
            let is_visible = slices.parameters[opacities + i] >= params.min_raw_opacity;
            let largest =
                (0..3).map(|k| slices.parameters[log_scales + 3 * i + k]).fold(f32::MIN, f32::max);
            let mean_gradient = mean_gradient(&slices, i);
            let fate = if !is_finite || !is_visible {
                FATE_PRUNE
            } else if mean_gradient > params.gradient_threshold {
                if largest > params.split_log_scale { FATE_SPLIT } else { FATE_CLONE }
            } else {
                FATE_KEEP
            };
            slices.mean_gradients[i] = mean_gradient;
            slices.fates[i] = fate;
            slices.offspring_counts[i] = [0, 1, 2, 2][fate as usize];
        }
    }
    /// A division is good to five roundings, and the reference's to one; the fate hangs on it at the threshold.
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        const ROUNDINGS: f64 = 6.0;
        let threshold = f64::from(params.gradient_threshold);
        let either = |i: usize| {
            let distance = (f64::from(mean_gradient(&slices, i)) - threshold).abs();
            if distance <= ROUNDINGS * UNIT * threshold { f64::from(FATE_SPLIT) } else { 0.0 }
        };
        let fates: Vec<f64> = (0..params.gaussian_count as usize).map(either).collect();
        Tolerances {
            mean_gradients: Tolerance::Roundings(ROUNDINGS),
            offspring_counts: Tolerance::Each(fates.clone()),
            fates: Tolerance::Each(fates),
        }
    }
}
