//! The convolution of `conv3x3` without activation, from packed factors, in double precision.

use super::conv3x3::sums;
use super::packed::{self, largest, scale, sum_error};
use super::rounding::UNIT;
use crate::gpu::Reference;
use crate::kernels::conv3x3;
use crate::kernels::conv3x3_half::{Constants, Kernel, Params, Slices, Tolerances};

/// The scaled sums and the sums of the magnitudes of their terms; the largest magnitudes of the factors.
struct Scaled {
    sums: Vec<f64>,
    magnitudes: Vec<f64>,
    largest: [f64; 2],
}

impl Scaled {
    fn new(params: &Params, slices: &Slices<'_>) -> Self {
        let Params { size, in_channels, out_channels, .. } = *params;
        let source = packed::map(size, in_channels, slices.source);
        let weights = packed::weights([in_channels, out_channels], slices.weights);
        let largest = [largest(&source), largest(&weights)];
        let layer = [weights, vec![0.0; out_channels as usize]].concat();
        let params = conv3x3::Params { size, in_channels, out_channels, offset: 0 };
        let of = |term: fn(f64) -> f64| sums(&params, false, &layer, &source, term);
        Self { sums: of(|x| x), magnitudes: of(f64::abs), largest }
    }
}

/// The divisor of the sum of two packed factors.
fn unit(slices: &Slices<'_>) -> f64 {
    scale(slices.largest_weight[0]) * scale(slices.largest_source[0])
}

/// The value that is added to a sum of channel `pixel / plane`.
fn bias(params: &Params, constants: &Constants, values: &[f32], pixel: usize) -> f64 {
    let channel = pixel / params.size.element_product() as usize;
    if constants.biased { values[params.biases as usize + channel].into() } else { 0.0 }
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let (unit, scaled) = (unit(&slices), Scaled::new(params, &slices));
        for (pixel, sum) in scaled.sums.into_iter().enumerate() {
            let kept = if constants.accumulate { slices.target[pixel].into() } else { 0.0 };
            let sum = sum / unit + bias(params, constants, slices.values, pixel);
            slices.target[pixel] = (sum + kept) as f32;
        }
    }

    /// The sum of products, and the rounding of each later operation.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let (unit, scaled) = (unit(&slices), Scaled::new(params, &slices));
        let bound = |(pixel, &magnitude): (usize, &f64)| {
            let kept = if constants.accumulate { slices.target[pixel].abs().into() } else { 0.0 };
            let beside = bias(params, constants, slices.values, pixel).abs() + kept;
            let of_sum = sum_error(9 * params.in_channels, magnitude, scaled.largest);
            of_sum / unit + 4.0 * UNIT * (magnitude / unit + beside)
        };
        Tolerances { target: scaled.magnitudes.iter().enumerate().map(bound).collect() }
    }
}
