use glam::Vec2;

use super::norm::moments;
use super::ssim_forward::widen;
use crate::gpu::Reference;
use crate::kernels::norm_statistics::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, Slices { source, partials }: Slices<'_>) {
        let pixels = params.pixel_count as usize;
        let channels = widen(&source[..params.channel_count as usize * pixels]);
        let chunks = channels.chunks(pixels).flat_map(|z| z.chunks(constants.chunk as usize));
        for (partial, chunk) in partials.iter_mut().zip(chunks) {
            let [mean, squares] = moments(chunk);
            *partial = Vec2::new(mean as f32, squares as f32);
        }
    }
}
