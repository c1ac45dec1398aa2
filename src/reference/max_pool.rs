use crate::gpu::Reference;
use crate::kernels::max_pool::{Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Self::Constants, Slices { source, target }: Slices<'_>) {
        let &Params { size, target_size, channels, window, stride } = params;
        let corners = (0..channels).flat_map(|c| {
            (0..target_size.y)
                .flat_map(move |y| (0..target_size.x).map(move |x| (c, stride * y, stride * x)))
        });
        for (target, (c, top, left)) in target.iter_mut().zip(corners) {
            let value = |t: u32| {
                source[((c * size.y + top + t / window) * size.x + left + t % window) as usize]
            };
            *target = (0..window * window).map(value).fold(f32::NEG_INFINITY, f32::max);
        }
    }
}
