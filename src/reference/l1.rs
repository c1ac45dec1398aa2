use super::inside;
use crate::gpu::Reference;
use crate::kernels::l1::{Constants, Kernel, Params, Slices};
use crate::tone::tone_curve;

impl Reference for Kernel {
    /// The whole sum goes into the first partial: how many there are is the device's choice.
    fn run(
        params: &Params,
        constants: &Constants,
        Slices { render, low, tone, d_render, partials }: Slices<'_>,
    ) {
        let mut sum = 0.0;
        for i in 0..params.value_count as usize {
            let mut difference = render[i] - tone_curve(constants.tone_curve, low[i], &tone[0]);
            let size = [params.width, params.height];
            if constants.with_interior
                && !inside(i, size, [params.interior_begin, params.interior_end])
            {
                difference = 0.0;
            }
            let sign = if difference == 0.0 { 0.0 } else { difference.signum() };
            d_render[i] = params.l1_scale * sign;
            sum += f64::from(difference.abs());
        }
        partials.fill(0.0);
        partials[0] = sum as f32;
    }
}
