use crate::gpu::Reference;
use crate::kernels::adam::{Constants, Kernel, Params, Slices};

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
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
            let column = i / gaussian_count;
            let gradient = if gradients[i].is_finite() {
                gradients[i].clamp(-GRADIENT_BOUND, GRADIENT_BOUND)
            } else {
                0.0
            };
            let m = BETA1 * first_moments[i] + (1.0 - BETA1) * gradient;
            let v = BETA2 * second_moments[i] + (1.0 - BETA2) * gradient * gradient;
            let step =
                rate_of(params, column) * m / (v.sqrt() * params.second_correction + EPSILON);
            first_moments[i] = m;
            second_moments[i] = v;
            parameters[i] -= step;
            if (7..10).contains(&column) {
                parameters[i] = parameters[i].clamp(LOG_SCALE_BOUNDS[0], LOG_SCALE_BOUNDS[1]);
            }
        }
    }
}
