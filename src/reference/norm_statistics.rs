use glam::Vec2;

use super::rounding::{UNIT, chain};
use super::widen;
use crate::gpu::Reference;
use crate::kernels::norm_statistics::{Constants, Kernel, Params, Slices, Tolerances};

/// Every chunk of every channel.
fn chunks(params: &Params, constants: &Constants, source: &[f32]) -> Vec<Vec<f64>> {
    let pixels = params.pixel_count as usize;
    let channels = source[..params.channel_count as usize * pixels].chunks(pixels);
    channels.flat_map(|z| z.chunks(constants.chunk as usize)).map(widen).collect()
}

/// The mean and the sum of squared deviations.
fn moments(values: &[f64]) -> [f64; 2] {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    [mean, values.iter().map(|z| (z - mean).powi(2)).sum()]
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let chunks = chunks(params, constants, slices.source);
        for (partial, chunk) in slices.partials.iter_mut().zip(chunks) {
            *partial = Vec2::from_array(moments(&chunk).map(|moment| moment as f32));
        }
    }

    /// The first mean has the rounding error of a sum. The sum of the deviations corrects it: the second mean has its
    /// own rounding and that of the deviations' sum.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let bounds = |chunk: Vec<f64>| {
            let ([mean, squares], n) = (moments(&chunk), chunk.len() as f64);
            let error = (chain(chunk.len()) + 6.0) * UNIT;
            let first = error * chunk.iter().map(|z| z.abs()).sum::<f64>() / n;
            let deviation = chunk.iter().map(|z| (z - mean).abs()).sum::<f64>() / n + first;
            let about_first = squares + n * first * first;
            [error * deviation + 2.0 * UNIT * mean.abs(), 2.0 * error * about_first]
        };
        let chunks = chunks(params, constants, slices.source).into_iter();
        Tolerances { partials: chunks.flat_map(bounds).collect() }
    }
}
