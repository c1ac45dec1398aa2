use crate::gpu::Reference;
use crate::kernels::product_backward::{Constants, Kernel, Params, Slices};

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
}
