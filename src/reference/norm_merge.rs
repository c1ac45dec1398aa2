use nightsplat_photographs::tone::Real;

use super::norm::NormStatistics;
use super::rounding::{Rounded, bounds_from, chain, write};
use crate::gpu::Reference;
use crate::kernels::norm_merge::{Constants, Kernel, Params, Slices, Tolerances};

/// Mean and 1 / standard deviation of every channel.
fn merged(params: &Params, constants: &Constants, slices: &Slices<'_>) -> Vec<Rounded> {
    let (pixels, chunk) = (params.pixel_count as usize, constants.chunk as usize);
    let (chunks, n) = (pixels.div_ceil(chunk), Rounded::from_f64(pixels as f64));
    let channel = |channel: usize| {
        let partials = || {
            let all = slices.partials[channel * chunks..][..chunks].iter().enumerate();
            all.map(|(k, partial)| {
                let count = Rounded::from_f64(chunk.min(pixels - k * chunk) as f64);
                (count, partial.to_array().map(Rounded::exact))
            })
        };
        let sum = |terms: &mut dyn Iterator<Item = Rounded>| Rounded::sum(chain(chunks), terms);
        let mean = sum(&mut partials().map(|(count, [mean, _])| count * mean)) / n;
        let squares = sum(&mut partials()
            .map(|(count, [of, squares])| squares + count * ((of - mean) * (of - mean))));
        let statistics = NormStatistics::new(mean, squares / n);
        [statistics.mean, statistics.inverse_deviation]
    };
    (0..params.channel_count as usize).flat_map(channel).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let merged = merged(params, constants, &slices);
        write(merged, &mut slices.statistics[params.slot as usize..]);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let merged = merged(params, constants, &slices);
        Tolerances { statistics: bounds_from(2 * params.slot as usize, merged) }
    }
}
