use glam::Vec2;

use super::norm::{affine, backward_sums};
use super::ssim_forward::widen;
use crate::gpu::Reference;
use crate::kernels::norm_backward_sums::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(
        params: &Params,
        constants: &Constants,
        Slices { values, statistics, source, d_target, partials }: Slices<'_>,
    ) {
        let (pixels, channels) = (params.pixel_count as usize, params.channel_count as usize);
        let chunk = constants.chunk as usize;
        let chunks = pixels.div_ceil(chunk);
        for channel in 0..channels {
            let affine = affine(values, params.offset, channels, channel);
            let statistics = statistics[params.slot as usize + channel].into();
            let [z, d] =
                [source, d_target].map(|image| widen(&image[channel * pixels..][..pixels]));
            for (k, (z, d)) in z.chunks(chunk).zip(d.chunks(chunk)).enumerate() {
                let sums = backward_sums(statistics, affine, z, d);
                partials[channel * chunks + k] = Vec2::from_array(sums.map(|sum| sum as f32));
            }
        }
    }
}
