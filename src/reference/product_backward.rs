use super::rounding::UNIT;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::product_backward::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { illumination, denoised, d_target, d_illumination, d_denoised }: Slices<'_>,
    ) {
        for i in 0..params.value_count as usize {
            d_illumination[i] = d_target[i] * denoised[i];
            d_denoised[i] += d_target[i] * illumination[i];
        }
    }

    /// The product may be fused into the addition, or rounded before it.
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let Slices { illumination, d_target, d_denoised, .. } = slices;
        let bound = |i: usize| {
            let product = f64::from(d_target[i]) * f64::from(illumination[i]);
            2.0 * UNIT * (2.0 * product.abs() + f64::from(d_denoised[i].abs()))
        };
        Tolerances {
            d_illumination: Tolerance::Roundings(1.0),
            d_denoised: (0..params.value_count as usize).map(bound).collect(),
        }
    }
}
