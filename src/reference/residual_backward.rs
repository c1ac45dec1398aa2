//! The gradient of the end of a denoiser stage in double precision.

use crate::gpu::{Reference, Tolerance};
use crate::kernels::residual_backward::{Constants, Kernel, Params, Slices, Tolerances};

/// The gradient of [`super::residual::residual`] with respect to its value before the clamp, which passes it within 0
/// and 1, including the bounds: the gradient of `R_0`, and the negative of those of I and u.
pub fn clamp_backward(difference: f64, d: f64) -> f64 {
    if (0.0..=1.0).contains(&difference) { d } else { 0.0 }
}

impl Reference for Kernel {
    fn run(
        params: &Params,
        constants: &Constants,
        Slices { render, stage_input, update, d_denoised, d_update, d_stage_input, d_render }: Slices<'_>,
    ) {
        if constants.identity {
            for i in 0..params.value_count as usize {
                d_update[i] = -d_denoised[i];
                d_stage_input[i] = d_denoised[i];
            }
            return;
        }
        for i in 0..params.value_count as usize {
            let difference = render[i] - (stage_input[i] + update[i]);
            let d = clamp_backward(difference.into(), d_denoised[i].into());
            let u = f64::from(update[i]);
            d_update[i] = (-d * u * (1.0 - u)) as f32;
            d_stage_input[i] = -d as f32;
            d_render[i] = (f64::from(d_render[i]) + d) as f32;
        }
    }

    /// A difference and two products; all other operations round identically.
    fn tolerances(_: &Params, _: &Constants, _: Slices<'_>) -> Tolerances {
        Tolerances { d_update: Tolerance::Roundings(4.0), ..Tolerances::default() }
    }
}
