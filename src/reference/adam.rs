use crate::attributes::{Attribute, planes};
use crate::gpu::Reference;
use crate::kernels::adam::{
    BETA1, BETA2, Constants, EPSILON, GRADIENT_BOUND, Kernel, LOG_SCALE_MAX, LOG_SCALE_MIN, Params,
    Slices,
};

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { parameters, gradients, first_moments, second_moments, status }: Slices<'_>,
    ) {
        if status[0] != 0 {
            return;
        }
        let [beta1, beta2, epsilon] = [BETA1, BETA2, EPSILON].map(|x| x as f32);
        let bound = GRADIENT_BOUND as f32;
        let gaussian_count = params.gaussian_count as usize;
        let planes = planes(params.feature_count as usize, params.column_count as usize);
        for i in 0..params.column_count as usize * gaussian_count {
            let column = i / gaussian_count;
            let plane = planes.iter().rposition(|(first, width)| *width > 0 && column >= *first);
            let plane = plane.unwrap_or_default();
            let gradient =
                if gradients[i].is_finite() { gradients[i].clamp(-bound, bound) } else { 0.0 };
            let m = beta1 * first_moments[i] + (1.0 - beta1) * gradient;
            let v = beta2 * second_moments[i] + (1.0 - beta2) * gradient * gradient;
            let step = params.rates[plane] * m / (v.sqrt() * params.second_correction + epsilon);
            first_moments[i] = m;
            second_moments[i] = v;
            parameters[i] -= step;
            if plane == Attribute::LogScales as usize {
                parameters[i] = parameters[i].clamp(LOG_SCALE_MIN as f32, LOG_SCALE_MAX as f32);
            }
        }
    }
}
