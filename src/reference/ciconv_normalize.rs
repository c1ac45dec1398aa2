use crate::gpu::Reference;
use crate::kernels::ciconv_normalize::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { logs, norm, structure }: Slices<'_>) {
        for i in 0..params.pixel_count as usize {
            structure[i] = ((logs[i] - norm[0].x) * norm[0].y).clamp(0.0, 1.0);
        }
    }
}
