use glam::Vec2;

use crate::gpu::Reference;
use crate::kernels::ciconv_moments::{Constants, EPSILON, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { moments, norm }: Slices<'_>) {
        let (pixels, size) = (params.pixel_count as usize, params.pixels_per_moment as usize);
        let chunks = || {
            let all = moments.iter().take(pixels.div_ceil(size)).enumerate();
            all.map(|(i, of)| (size.min(pixels - i * size) as f64, of.as_dvec2()))
        };
        let mean = chunks().map(|(count, of)| count * of.x).sum::<f64>() / pixels as f64;
        let squares: f64 = chunks().map(|(count, of)| of.y + count * (of.x - mean).powi(2)).sum();
        let deviation = (squares / pixels as f64 + EPSILON).sqrt();
        norm[0] = Vec2::new(mean as f32, (1.0 / deviation) as f32);
    }
}
