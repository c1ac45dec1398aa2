use super::norm::Statistics;
use crate::gpu::Reference;
use crate::kernels::ChannelStatistics;
use crate::kernels::norm_merge::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, Slices { partials, statistics }: Slices<'_>) {
        let (pixels, chunk) = (params.pixel_count as usize, constants.chunk as usize);
        let chunks = pixels.div_ceil(chunk);
        let count = |k: usize| chunk.min(pixels - k * chunk) as f64;
        for channel in 0..params.channel_count as usize {
            let partials = &partials[channel * chunks..][..chunks];
            let mean_of = |k: usize| f64::from(partials[k].x);
            let sum: f64 = (0..chunks).map(|k| count(k) * mean_of(k)).sum();
            let mean = sum / pixels as f64;
            let squares: f64 = (0..chunks)
                .map(|k| f64::from(partials[k].y) + count(k) * (mean_of(k) - mean).powi(2))
                .sum();
            let merged = Statistics::new(mean, squares / pixels as f64);
            statistics[params.slot as usize + channel] = ChannelStatistics {
                mean: merged.mean as f32,
                inverse_deviation: merged.inverse_deviation as f32,
            };
        }
    }
}
