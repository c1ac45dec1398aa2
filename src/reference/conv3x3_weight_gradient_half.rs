//! The partial sums of `conv3x3_weight_gradient` from packed factors, in double precision.

use super::conv3x3_weight_gradient::strips;
use super::packed::{self, largest, scale, sum_error};
use crate::gpu::Reference;
use crate::kernels::conv3x3_weight_gradient;
use crate::kernels::conv3x3_weight_gradient_half::{Constants, Kernel, Params, Slices, Tolerances};

/// The scaled sums of packed factors, of `term` of each factor.
fn sums(
    params: &Params,
    constants: &Constants,
    [source, d_target]: [&[f32]; 2],
    term: fn(f64) -> f64,
) -> Vec<f64> {
    let Params { size, in_channels, out_channels } = *params;
    let params = conv3x3_weight_gradient::Params { size, in_channels, out_channels };
    let sums = strips(&params, constants.rows, source, d_target, term);
    // Each strip has sums of biases beside those of weights.
    let weights = (9 * in_channels * out_channels) as usize;
    sums.chunks(weights + out_channels as usize)
        .flat_map(|strip| &strip[..weights])
        .copied()
        .collect()
}

/// The divisor of the sum of two packed factors.
fn unit(slices: &Slices<'_>) -> f64 {
    scale(slices.source_bound[0]) * scale(slices.d_target_bound[0])
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
        let sums = sums(params, constants, [&source, &d_target], |x| x);
        for (partial, sum) in slices.partials.iter_mut().zip(sums) {
            *partial = (sum / unit) as f32;
        }
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let (unit, [source, d_target]) = (unit(&slices), factors(params, &slices));
        let magnitudes = sums(params, constants, [&source, &d_target], f64::abs);
        let (pixels, largest) =
            (constants.rows * params.size.x, [largest(&source), largest(&d_target)]);
        let bound = |&magnitude: &f64| sum_error(pixels, magnitude, largest) / unit;
        Tolerances { partials: magnitudes.iter().map(bound).collect() }
    }
}
