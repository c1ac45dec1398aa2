use super::rounding::UNIT;
use crate::attributes::{Attribute, planes};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::densify_score::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::fate::{KEY_KEEP, KEY_PRUNE, KEY_TOP, TALLY_CANDIDATES, TALLY_PRUNED};

fn mean_gradient(slices: &Slices<'_>, i: usize) -> f32 {
    match slices.visit_counts[i] {
        0 => 0.0,
        visits => slices.grad_norm_sums[i] / visits as f32,
    }
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let n = params.gaussian_count as usize;
        let opacities = Attribute::RawOpacities.column(0) * n;
        let [features, columns] = [params.feature_count, params.column_count].map(|n| n as usize);
        for i in 0..n {
            let is_finite = planes(features, columns).iter().all(|(column, width)| {
                (0..*width).all(|k| slices.parameters[column * n + width * i + k].abs() < 3e38)
            });
            let is_visible = slices.parameters[opacities + i] >= params.min_raw_opacity;
            let mean_gradient = mean_gradient(&slices, i);
            let key = if !is_finite || !is_visible {
                KEY_PRUNE
            } else if mean_gradient > params.gradient_threshold {
                KEY_TOP - mean_gradient.to_bits()
            } else {
                KEY_KEEP
            };
            slices.keys[i] = key;
            slices.ids[i] = params.first_gaussian + i as u32;
            slices.tally[TALLY_CANDIDATES as usize] += u32::from(key < KEY_KEEP);
            slices.tally[TALLY_PRUNED as usize] += u32::from(key == KEY_PRUNE);
        }
    }

    /// A division is good to five roundings, and the reference's to one: as many units of a key, which is made of bits,
    /// and a unit is up to two roundings. At the threshold, whether there is a candidate hangs on it.
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        const ROUNDINGS: f64 = 6.0;
        let threshold = f64::from(params.gradient_threshold);
        let is_close = |i: usize| {
            let distance = (f64::from(mean_gradient(&slices, i)) - threshold).abs();
            distance <= ROUNDINGS * UNIT * threshold
        };
        let n = params.gaussian_count as usize;
        let keys = (0..n).map(|i| if is_close(i) { f64::from(u32::MAX) } else { ROUNDINGS });
        let close = (0..n).filter(|&i| is_close(i)).count();
        Tolerances {
            keys: Tolerance::Each(keys.collect()),
            tally: Tolerance::Each(vec![close as f64]),
            ..Tolerances::default()
        }
    }
}
