use super::rounding::Rounded;
use crate::attributes::{Attribute, planes};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::adam::{
    BETA1, BETA2, Constants, EPSILON, GRADIENT_BOUND, Kernel, LOG_SCALE_MAX, LOG_SCALE_MIN, Params,
    Slices, Tolerances,
};
use crate::tone::Real;

/// The parameter and both moments after the step. A compiler folds 1 - beta in double precision.
fn updated<T: Real>(params: &Params, column: usize, [p, g, m, v]: [f32; 4]) -> [T; 3] {
    let of = |x: f32| T::of(x.into());
    let planes = planes(params.feature_count as usize, params.column_count as usize);
    let plane = planes.iter().rposition(|(first, width)| *width > 0 && column >= *first);
    let plane = plane.unwrap_or_default();
    let bound = GRADIENT_BOUND as f32;
    let g = if g.is_finite() { g.clamp(-bound, bound) } else { 0.0 };
    let [old, new] = [BETA1, 1.0 - BETA1].map(|beta| of(beta as f32));
    let m = old * of(m) + new * of(g);
    let [old, new] = [BETA2, 1.0 - BETA2].map(|beta| of(beta as f32));
    let v = old * of(v) + new * of(g) * of(g);
    let divisor = v.sqrt() * of(params.second_correction) + of(EPSILON as f32);
    let p = of(p) - of(params.rates[plane]) * m / divisor;
    let [low, high] = [LOG_SCALE_MIN, LOG_SCALE_MAX].map(|bound| of(bound as f32));
    let bounded = match plane == Attribute::LogScales as usize {
        // Phrased so that a NaN stays one.
        true if p < low => low,
        true if p > high => high,
        _ => p,
    };
    [bounded, m, v]
}

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { parameters, gradients, first_moments, second_moments, status }: Slices<'_>,
    ) {
        if status[0] != 0 {
            return;
        }
        let gaussian_count = params.gaussian_count as usize;
        for i in 0..params.column_count as usize * gaussian_count {
            let before = [parameters[i], gradients[i], first_moments[i], second_moments[i]];
            [parameters[i], first_moments[i], second_moments[i]] =
                updated(params, i / gaussian_count, before);
        }
    }

    /// Twice the running error: the reference rounds too.
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let Slices { parameters, gradients, first_moments, second_moments, status } = slices;
        let count = if status[0] == 0 { params.column_count * params.gaussian_count } else { 0 };
        let bounds = |which: usize| {
            let of = |i: usize| {
                let before = [parameters[i], gradients[i], first_moments[i], second_moments[i]];
                let column = i / params.gaussian_count as usize;
                2.0 * updated::<Rounded>(params, column, before)[which].error
            };
            Tolerance::Each((0..count as usize).map(of).collect())
        };
        let [parameters, first_moments, second_moments] = [0, 1, 2].map(bounds);
        Tolerances { parameters, first_moments, second_moments }
    }
}
