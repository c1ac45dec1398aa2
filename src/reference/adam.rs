use nightsplat_models::attributes::{Attribute, planes};
use nightsplat_photographs::tone::Real;

use super::rounding::Rounded;
use crate::gpu::Reference;
use crate::kernels::adam::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::adam_step::{BETA1, BETA2, EPSILON, GRADIENT_BOUND};
use crate::kernels::log_scale::{LOG_SCALE_MAX, LOG_SCALE_MIN};
use crate::splats::batches::frozen_floats;

/// The parameter and both moments after a step at `rate`. A compiler folds 1 - beta in double precision.
pub(super) fn stepped<T: Real>(
    [rate, second_correction]: [f32; 2],
    [p, g, m, v]: [f32; 4],
) -> [T; 3] {
    let of = |x: f32| T::from_f64(x.into());
    let g = clamp_gradient(g);
    let [old, new] = [BETA1, 1.0 - BETA1].map(|beta| of(beta as f32));
    let m = old * of(m) + new * of(g);
    let [old, new] = [BETA2, 1.0 - BETA2].map(|beta| of(beta as f32));
    let v = old * of(v) + new * of(g) * of(g);
    let divisor = v.sqrt() * of(second_correction) + of(EPSILON as f32);
    [of(p) - of(rate) * m / divisor, m, v]
}

pub(super) fn clamp_gradient(gradient: f32) -> f32 {
    let bound = GRADIENT_BOUND as f32;
    if gradient.is_finite() { gradient.clamp(-bound, bound) } else { 0.0 }
}

/// The parameter and both moments after the step.
fn updated<T: Real>(params: &Params, column: usize, before: [f32; 4]) -> [T; 3] {
    let planes = planes(params.feature_count as usize, params.column_count as usize);
    let plane = planes.iter().rposition(|plane| plane.width > 0 && column >= plane.column);
    let plane = plane.unwrap_or_default();
    bounded(plane, stepped::<T>([params.rates[plane], params.second_correction], before))
}

/// The parameter, which has bounds in the plane of the log scales, and both moments.
pub(super) fn bounded<T: Real>(plane: usize, [p, m, v]: [T; 3]) -> [T; 3] {
    let [low, high] =
        [LOG_SCALE_MIN, LOG_SCALE_MAX].map(|bound| T::from_f64((bound as f32).into()));
    let bounded = match plane == Attribute::LogScales as usize {
        // Written so that a NaN stays one.
        true if p < low => low,
        true if p > high => high,
        _ => p,
    };
    [bounded, m, v]
}

/// Parameter `i`, its gradient and both moments; `trained` is its index among the trained ones.
fn before(slices: &Slices<'_>, i: usize, trained: usize) -> [f32; 4] {
    let Slices { parameters, gradients, first_moments, second_moments, .. } = slices;
    [parameters[i], gradients[trained], first_moments[trained], second_moments[trained]]
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        if slices.status[0] != 0 {
            return;
        }
        let gaussian_count = params.gaussian_count as usize;
        let frozen = constants.frozen_columns as usize * gaussian_count;
        let left_out = frozen_floats(constants.frozen_columns, gaussian_count);
        for i in frozen..params.column_count as usize * gaussian_count {
            let trained = i - left_out;
            let before = before(&slices, i, trained);
            let [parameter, first, second] = updated(params, i / gaussian_count, before);
            slices.parameters[i] = parameter;
            (slices.first_moments[trained], slices.second_moments[trained]) = (first, second);
        }
    }

    /// Twice the running error, since the reference rounds too.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let count =
            if slices.status[0] == 0 { params.column_count * params.gaussian_count } else { 0 };
        let frozen = (constants.frozen_columns * params.gaussian_count) as usize;
        let left_out = frozen_floats(constants.frozen_columns, params.gaussian_count as usize);
        let bounds = |which: usize| {
            let of = |i: usize| {
                if i < frozen {
                    return 0.0;
                }
                let before = before(&slices, i, i - left_out);
                let column = i / params.gaussian_count as usize;
                2.0 * updated::<Rounded>(params, column, before)[which].error
            };
            let first = if which == 0 { 0 } else { left_out };
            (first..count as usize).map(of).collect()
        };
        let parameters = bounds(0);
        let [first_moments, second_moments] = [1, 2].map(bounds);
        Tolerances { parameters, first_moments, second_moments }
    }
}
