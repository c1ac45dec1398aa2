use super::rounding::UNIT;
use crate::attributes::{Attribute, planes};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::densify_score::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::fate::{
    KEY_KEEP, KEY_PRUNE, KEY_TOP, TALLY_CANDIDATES, TALLY_PRUNED, WIDEST_SPLIT,
};

fn mean_gradient(slices: &Slices<'_>, i: usize) -> f32 {
    match slices.visit_counts[i] {
        0 => 0.0,
        visits => slices.grad_norm_sums[i] / visits as f32,
    }
}

/// The squared distance of the nearest camera, in units of what the width of a Gaussian asks for, and the logarithm of
/// that width.
fn nearness(params: &Params, slices: &Slices<'_>, i: usize) -> [f64; 2] {
    let n = params.gaussian_count as usize;
    let of = |attribute: Attribute| -> [f64; 3] {
        let first = attribute.column(0) * n + 3 * i;
        std::array::from_fn(|k| f64::from(slices.parameters[first + k]))
    };
    let [mean, log_scales] = [Attribute::Means, Attribute::LogScales].map(of);
    let width = log_scales.into_iter().fold(f64::NEG_INFINITY, f64::max);
    let cameras = slices.cameras.chunks_exact(3).take(params.camera_count as usize);
    let squared = cameras.map(|camera| {
        let away = mean.iter().zip(camera).map(|(mean, camera)| mean - f64::from(*camera));
        away.map(|away| away * away).sum::<f64>()
    });
    let least = width.exp() / WIDEST_SPLIT;
    [squared.fold(f64::INFINITY, f64::min) / (least * least), width]
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
            } else if mean_gradient > params.gradient_threshold
                && nearness(params, &slices, i)[0] >= 1.0
            {
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
    /// and a unit is up to two roundings. At the threshold, whether there is a candidate hangs on it, and as near as a camera
    /// may be on an exponential, good to 3 + 2 |x| units (Vulkan 1.3, appendix on precision).
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        const ROUNDINGS: f64 = 6.0;
        let threshold = f64::from(params.gradient_threshold);
        let is_close = |i: usize| {
            let distance = (f64::from(mean_gradient(&slices, i)) - threshold).abs();
            let [nearness, width] = nearness(params, &slices, i);
            let of_nearness = (2.0 * (3.0 + 2.0 * width.abs()) + 4.0 * ROUNDINGS) * UNIT;
            distance <= ROUNDINGS * UNIT * threshold || (nearness - 1.0).abs() <= of_nearness
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
