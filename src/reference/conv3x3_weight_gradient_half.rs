//! The partial sums of `conv3x3_weight_gradient` from packed factors, in double precision.

use super::conv3x3_weight_gradient::strips;
use super::packed::{self, largest, scale, sum_error};
use super::rounding::UNIT;
use crate::gpu::Reference;
use crate::kernels::conv3x3_weight_gradient;
use crate::kernels::conv3x3_weight_gradient_half::{Constants, Kernel, Params, Slices, Tolerances};

/// The scaled sums of packed factors for the weights, and single-precision sums for the biases, of `term` of each
/// factor.
fn sums(
    params: &Params,
    constants: &Constants,
    [source, d_target, d_single]: [&[f32]; 3],
    term: fn(f64) -> f64,
) -> Vec<f64> {
    let Params { size, in_channels, out_channels } = *params;
    let params = conv3x3_weight_gradient::Params { size, in_channels, out_channels };
    let mut sums = strips(&params, constants.rows, source, d_target, term);
    let single = conv3x3_weight_gradient::Params { in_channels: 0, ..params };
    let biases = strips(&single, constants.rows, &[], d_single, term);
    let of_strip = (out_channels * (9 * in_channels + 1)) as usize;
    let biases = biases.chunks(out_channels as usize);
    for (strip, biases) in sums.chunks_mut(of_strip).zip(biases) {
        strip[of_strip - biases.len()..].copy_from_slice(biases);
    }
    sums
}

/// The number of a strip's sums for weights, and for weights and biases.
fn lengths(params: &Params) -> [usize; 2] {
    let weights = 9 * params.in_channels * params.out_channels;
    [weights, weights + params.out_channels].map(|n| n as usize)
}

/// The divisor of the sum of two packed factors.
fn unit(slices: &Slices<'_>) -> f64 {
    scale(slices.largest_source[0]) * scale(slices.largest_d_target[0])
}

/// Both factors.
fn factors(params: &Params, slices: &Slices<'_>) -> [Vec<f32>; 2] {
    let Params { size, in_channels, out_channels } = *params;
    [(in_channels, slices.source), (out_channels, slices.d_target)]
        .map(|(channels, map)| packed::map(size, channels, map))
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let (unit, [source, d_target]) = (unit(&slices), factors(params, &slices));
        let maps = [&source[..], &d_target, slices.d_target_single];
        let sums = sums(params, constants, maps, |x| x);
        let [weights, of_strip] = lengths(params);
        for (i, (partial, sum)) in slices.partials.iter_mut().zip(sums).enumerate() {
            *partial = if i % of_strip < weights { sum / unit } else { sum } as f32;
        }
    }

    /// The sums of products; those of biases round once per pixel.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let (unit, [source, d_target]) = (unit(&slices), factors(params, &slices));
        let maps = [&source[..], &d_target, slices.d_target_single];
        let magnitudes = sums(params, constants, maps, f64::abs);
        let [weights, of_strip] = lengths(params);
        let (pixels, largest) =
            (constants.rows * params.size.x, [largest(&source), largest(&d_target)]);
        let bound = |(i, &magnitude): (usize, &f64)| {
            if i % of_strip < weights {
                return sum_error(pixels, magnitude, largest) / unit;
            }
            (f64::from(pixels) + 2.0) * UNIT * magnitude
        };
        Tolerances { partials: magnitudes.iter().enumerate().map(bound).collect() }
    }
}
