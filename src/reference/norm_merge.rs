use super::norm::Statistics;
use super::rounding::{Rounded, chain};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::ChannelStatistics;
use crate::kernels::norm_merge::{Constants, Kernel, Params, Slices, Tolerances};
use crate::photographs::tone::Real;

/// The statistics of every channel.
fn merged(params: &Params, constants: &Constants, slices: &Slices<'_>) -> Vec<Statistics<Rounded>> {
    let (pixels, chunk) = (params.pixel_count as usize, constants.chunk as usize);
    let (chunks, n) = (pixels.div_ceil(chunk), Rounded::of(pixels as f64));
    let channel = |channel: usize| {
        let partials = || {
            let all = slices.partials[channel * chunks..][..chunks].iter().enumerate();
            all.map(|(k, partial)| {
                let count = Rounded::of(chunk.min(pixels - k * chunk) as f64);
                (count, partial.to_array().map(Rounded::exact))
            })
        };
        let sum = |terms: &mut dyn Iterator<Item = Rounded>| Rounded::sum(chain(chunks), terms);
        let mean = sum(&mut partials().map(|(count, [mean, _])| count * mean)) / n;
        let squares = sum(&mut partials()
            .map(|(count, [of, squares])| squares + count * ((of - mean) * (of - mean))));
        Statistics::new(mean, squares / n)
    };
    (0..params.channel_count as usize).map(channel).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let merged = merged(params, constants, &slices);
        for (to, of) in slices.statistics[params.slot as usize..].iter_mut().zip(merged) {
            *to = ChannelStatistics {
                mean: of.mean.value as f32,
                inverse_deviation: of.inverse_deviation.value as f32,
            };
        }
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let merged = merged(params, constants, &slices);
        let mut bounds = vec![0.0; 2 * params.slot as usize];
        bounds.extend(
            merged.iter().flat_map(|of| [of.mean, of.inverse_deviation].map(Rounded::bound)),
        );
        Tolerances { statistics: Tolerance::Each(bounds) }
    }
}
