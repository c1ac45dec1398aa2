use crate::attributes::{Attribute, planes};
use crate::gpu::Reference;
use crate::kernels::adam::{Constants, Kernel, Params, Slices};

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-15;
const GRADIENT_BOUND: f32 = 1e18;

/// The bounds of the natural logarithm of a scale.
pub(super) const LOG_SCALE_BOUNDS: [f32; 2] = [-30.0, 13.0];

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
        let planes = planes(params.feature_count as usize, params.column_count as usize);
        for i in 0..params.column_count as usize * gaussian_count {
            let column = i / gaussian_count;
            let plane = planes.iter().rposition(|(first, width)| *width > 0 && column >= *first);
            let plane = plane.unwrap_or_default();
            let gradient = if gradients[i].is_finite() {
                gradients[i].clamp(-GRADIENT_BOUND, GRADIENT_BOUND)
            } else {
                0.0
            };
            let m = BETA1 * first_moments[i] + (1.0 - BETA1) * gradient;
            let v = BETA2 * second_moments[i] + (1.0 - BETA2) * gradient * gradient;
            let step = params.rates[plane] * m / (v.sqrt() * params.second_correction + EPSILON);
            first_moments[i] = m;
            second_moments[i] = v;
            parameters[i] -= step;
            if plane == Attribute::LogScales as usize {
                parameters[i] = parameters[i].clamp(LOG_SCALE_BOUNDS[0], LOG_SCALE_BOUNDS[1]);
            }
        }
    }
}
