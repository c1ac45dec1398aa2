//! The score of each Gaussian for densification, and the estimated change of the cameras' views by a split.

use glam::{DMat3, DVec2};
use nightsplat_models::attributes::Attribute;

use super::camera::ReferenceCamera;
use super::gaussian::{Gaussian, Planes, Words, sigmoid};
use super::rotation::{rotation, unit_quat};
use super::rounding::UNIT;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::camera::NEAREST;
use crate::kernels::densify_action::{
    COUNTER_CANDIDATES, COUNTER_PRUNED, KEY_KEEP, KEY_PRUNE, KEY_TOP, SPLIT_OFFSET,
};
use crate::kernels::densify_score::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::splat::DILATION;

fn mean_gradient(slices: &Slices<'_>, i: usize) -> f32 {
    match slices.visit_counts[i] {
        0 => 0.0,
        visits => slices.grad_norm_sums[i] / visits as f32,
    }
}

/// An estimate of the mean squared change of a view by a split, in units of the squared contrast of the area that the
/// Gaussian covers: the fraction of the view that it covers, times the square of its opacity and of the relative change
/// of depth.
pub(super) fn view_change(near: f64, camera: &ReferenceCamera, gaussian: &Gaussian) -> f64 {
    let opacity = sigmoid(gaussian.raw_opacity);
    let scale = DMat3::from_diagonal(gaussian.log_scale.exp());
    let view_axes = camera.rotation * rotation(unit_quat(gaussian.quat)) * scale;
    let mean = camera.view(gaussian.mean);
    let depth = camera.depth(mean);
    let longest = view_axes.col(gaussian.log_scale.max_position());
    let shift = SPLIT_OFFSET * camera.depth_change(mean, longest).abs();
    if depth + shift <= near {
        return 0.0;
    }
    let depth = (depth - shift).max(near.max(NEAREST));
    let mean = camera.at_depth(mean, depth);
    if camera.depth(mean) <= 0.0 {
        return 0.0;
    }
    let rows = view_axes.transpose();
    let [u0, u1] = camera.jacobian(mean).map(|row| rows * row);
    let variance = DVec2::new(u0.dot(u0), u1.dot(u1)) + DILATION;
    let level = 2.002 * (255.0 * opacity).ln() + 1e-3;
    let half_extent = (level.max(0.0) * variance).map(f64::sqrt);
    let mean2d = camera.project(mean);
    let clamped = |corner: DVec2| corner.clamp(DVec2::ZERO, camera.size);
    let covered = (clamped(mean2d + half_extent) - clamped(mean2d - half_extent)) / camera.size;
    covered.element_product() * (opacity * shift / depth).powi(2)
}

/// The largest change of a camera's view by a split of Gaussian `i`; NaN if any is.
fn largest_change(params: &Params, slices: &Slices<'_>, i: usize) -> f64 {
    let count = params.gaussian_count as usize;
    let planes = Planes { count, feature_count: 0, sh_degree: 0, rest_by_column: false };
    let gaussian = planes.load(slices.parameters, i);
    let cameras = slices.cameras.iter().take(params.camera_count as usize);
    let change =
        |camera| view_change(params.near.into(), &ReferenceCamera::from(camera), &gaussian);
    let most = |most: f64, one: f64| if most >= one { most } else { one };
    cameras.map(change).fold(0.0, |a, b| if f64::is_nan(a) { a } else { most(a, b) })
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let n = params.gaussian_count as usize;
        let opacities = Attribute::RawOpacities.column(0) * n;
        let widths = [params.feature_count, params.column_count];
        let words = Words::new(n, widths, constants.rest_by_column);
        for i in 0..n {
            let is_finite = words.of_gaussian(i).all(|at| slices.parameters[at].abs() < 3e38);
            let is_visible = slices.parameters[opacities + i] >= params.min_raw_opacity;
            let mean_gradient = mean_gradient(&slices, i);
            let key = if !is_finite || !is_visible {
                KEY_PRUNE
            } else if mean_gradient > params.gradient_threshold
                && largest_change(params, &slices, i) <= f64::from(params.largest_change)
            {
                KEY_TOP - mean_gradient.to_bits()
            } else {
                KEY_KEEP
            };
            slices.keys[i] = key;
            slices.ids[i] = params.first_gaussian + i as u32;
            slices.counters[COUNTER_CANDIDATES as usize] += u32::from(key < KEY_KEEP);
            slices.counters[COUNTER_PRUNED as usize] += u32::from(key == KEY_PRUNE);
        }
    }

    /// A division has an error of five roundings, and the reference's of one: as many units of a key, which is made of
    /// bits, and a unit is up to two roundings. At the threshold, they decide whether there is a candidate. The same
    /// applies if a view would change by about the bound, within a thousandth of it: the precision of exponentials,
    /// differences of depths and edges of splats for parameters below about 1 000.
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        const ROUNDINGS: f64 = 6.0;
        let (threshold, bound) =
            (f64::from(params.gradient_threshold), f64::from(params.largest_change));
        let is_close = |i: usize| {
            let gradient = f64::from(mean_gradient(&slices, i));
            let is_near = |value: f64, limit: f64, part: f64| (value - limit).abs() <= part * limit;
            is_near(gradient, threshold, ROUNDINGS * UNIT)
                || (gradient > threshold
                    && is_near(largest_change(params, &slices, i), bound, 1e-3))
        };
        let n = params.gaussian_count as usize;
        let key_bound = |i| if is_close(i) { f64::from(u32::MAX) } else { ROUNDINGS };
        let close = (0..n).filter(|&i| is_close(i)).count();
        Tolerances {
            keys: (0..n).map(key_bound).collect(),
            counters: Tolerance::Each(vec![close as f64]),
            ..Tolerances::default()
        }
    }
}
