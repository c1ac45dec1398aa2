use crate::gpu::Reference;
use crate::kernels::norm_backward_merge::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(
        params: &Params,
        constants: &Constants,
        Slices { partials, sums, gradients }: Slices<'_>,
    ) {
        let chunks = params.pixel_count.div_ceil(constants.chunk) as usize;
        let channels = params.channel_count as usize;
        for channel in 0..channels {
            let of_channel = &partials[channel * chunks..][..chunks];
            let sum = of_channel.iter().map(|partial| partial.as_dvec2()).sum::<glam::DVec2>();
            sums[channel] = sum.as_vec2();
            let at = params.offset as usize + channel;
            gradients[at] = (f64::from(gradients[at]) + sum.y) as f32;
            gradients[at + channels] = (f64::from(gradients[at + channels]) + sum.x) as f32;
        }
    }
}
