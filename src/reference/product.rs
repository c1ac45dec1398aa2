use crate::gpu::Reference;
use crate::kernels::product::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { illumination, denoised, target }: Slices<'_>) {
        for i in 0..params.value_count as usize {
            target[i] = illumination[i] * denoised[i];
        }
    }
}
