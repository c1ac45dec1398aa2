use super::norm::{affine, backward};
use super::ssim_forward::widen;
use crate::gpu::Reference;
use crate::kernels::norm_backward::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { values, statistics, sums, source, d_target, d_source }: Slices<'_>,
    ) {
        let (pixels, channels) = (params.pixel_count as usize, params.channel_count as usize);
        for channel in 0..channels {
            let affine = affine(values, params.offset, channels, channel);
            let statistics = statistics[params.slot as usize + channel].into();
            let means = (sums[channel].as_dvec2() / pixels as f64).to_array();
            let plane = channel * pixels;
            let [z, d] = [source, d_target].map(|image| widen(&image[plane..][..pixels]));
            let d_z = backward(statistics, affine, means, &z, &d);
            for i in 0..pixels {
                d_source[plane + i] = d_z[i] as f32;
            }
        }
    }
}
