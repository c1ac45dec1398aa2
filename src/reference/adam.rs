use super::real::Real;
use super::rounding::Rounded;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::adam::{Constants, Kernel, Params, Slices, Tolerances};

// A compiler folds 1 - beta in double precision.
const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPSILON: f32 = 1e-15;
const GRADIENT_BOUND: f32 = 1e18;

/// The bounds of the natural logarithm of a scale.
pub(super) const LOG_SCALE_BOUNDS: [f32; 2] = [-30.0, 13.0];

fn rate_of(params: &Params, column: usize) -> f32 {
    match column {
        0..3 => params.means_rate,
        3..7 => params.quats_rate,
        7..10 => params.log_scales_rate,
        10 => params.raw_opacities_rate,
        11..14 => params.dc_rate,
        _ if column < 14 + params.feature_count as usize => params.features_rate,
        _ => params.rest_rate,
    }
}

/// The parameter and both moments after the step.
fn updated<T: Real>(params: &Params, column: usize, [p, g, m, v]: [f32; 4]) -> [T; 3] {
    let of = |x: f32| T::of(x.into());
    let g = if g.is_finite() { g.clamp(-GRADIENT_BOUND, GRADIENT_BOUND) } else { 0.0 };
    let [old, new] = [BETA1, 1.0 - BETA1].map(|beta| of(beta as f32));
    let m = old * of(m) + new * of(g);
    let [old, new] = [BETA2, 1.0 - BETA2].map(|beta| of(beta as f32));
    let v = old * of(v) + new * of(g) * of(g);
    let step =
        of(rate_of(params, column)) * m / (v.sqrt() * of(params.second_correction) + of(EPSILON));
    let p = of(p) - step;
    let [low, high] = LOG_SCALE_BOUNDS.map(of);
    // Phrased so that a NaN stays one.
    let bounded = if p < low {
        low
    } else if p > high {
        high
    } else {
        p
    };
    [if (7..10).contains(&column) { bounded } else { p }, m, v]
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
