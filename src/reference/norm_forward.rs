use super::norm::{affine, forward};
use super::ssim_forward::widen;
use crate::gpu::Reference;
use crate::kernels::norm_forward::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { values, statistics, source, shortcut, target }: Slices<'_>,
    ) {
        let (pixels, channels) = (params.pixel_count as usize, params.channel_count as usize);
        for channel in 0..channels {
            let affine = affine(values, params.offset, channels, channel);
            let statistics = statistics[params.slot as usize + channel].into();
            let plane = channel * pixels;
            let added = forward(statistics, affine, &widen(&source[plane..][..pixels]));
            for i in 0..pixels {
                target[plane + i] = (f64::from(shortcut[plane + i]) + added[i]) as f32;
            }
        }
    }
}
