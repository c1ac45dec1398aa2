use crate::gpu::Reference;
use crate::kernels::adam::{
    BETA1, BETA2, Constants, EPSILON, GRADIENT_BOUND, Kernel, LOG_SCALE_MAX, LOG_SCALE_MIN, Params,
    Slices,
};

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
        let [beta1, beta2, epsilon] = [BETA1, BETA2, EPSILON].map(|x| x as f32);
        let bound = GRADIENT_BOUND as f32;
        let gaussian_count = params.gaussian_count as usize;
        for i in 0..params.column_count as usize * gaussian_count {
            let column = i / gaussian_count;
            let gradient =
                if gradients[i].is_finite() { gradients[i].clamp(-bound, bound) } else { 0.0 };
            let m = beta1 * first_moments[i] + (1.0 - beta1) * gradient;
            let v = beta2 * second_moments[i] + (1.0 - beta2) * gradient * gradient;
            let step =
                rate_of(params, column) * m / (v.sqrt() * params.second_correction + epsilon);
            first_moments[i] = m;
            second_moments[i] = v;
            parameters[i] -= step;
            if (7..10).contains(&column) {
                parameters[i] = parameters[i].clamp(LOG_SCALE_MIN as f32, LOG_SCALE_MAX as f32);
            }
        }
    }
}
