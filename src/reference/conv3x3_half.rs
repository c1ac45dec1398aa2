//! The convolution of `conv3x3` without biases and activation, from packed factors, in double precision.

use super::conv3x3::sums;
use super::packed::{self, PackedOutput, largest, scale, sum_error};
use super::rounding::Rounded;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::conv3x3;
use crate::kernels::conv3x3_half::{Constants, Kernel, Params, Slices, Tolerances};

/// The bound of the target, with the operations of the kernel.
fn bound(params: &Params, constants: &Constants, slices: &Slices<'_>) -> u32 {
    let of_terms = (9 * params.in_channels) as f32 * f32::from_bits(slices.weight_bound[0]);
    let of_sum = of_terms * f32::from_bits(slices.source_bound[0]);
    let shortcut = f32::from_bits(slices.shortcut_largest[params.largest_index as usize]);
    (of_sum + if constants.accumulate { shortcut } else { 0.0 }).to_bits()
}

/// The sums of products and what is added to, with the rounding of each operation; (C, H, W).
fn target(params: &Params, constants: &Constants, slices: &Slices<'_>) -> PackedOutput {
    let Params { size, in_channels, out_channels, .. } = *params;
    let bound = bound(params, constants, slices);
    let source = packed::map(size, in_channels, slices.source);
    let weights = packed::weights([in_channels, out_channels], slices.weights);
    let factors = [largest(&source), largest(&weights)];
    let layer = [weights, vec![0.0; out_channels as usize]].concat();
    let params = conv3x3::Params { size, in_channels, out_channels, offset: 0 };
    let of = |term: fn(f64) -> f64| sums(&params, false, &layer, &source, term);
    let unit = scale(slices.weight_bound[0]) * scale(slices.source_bound[0]);
    let sum = |(value, magnitude): (f64, f64)| Rounded {
        value: value / unit,
        error: sum_error(9 * in_channels, magnitude, factors) / unit,
    };
    let sums = of(|x| x).into_iter().zip(of(f64::abs)).map(sum);
    let mut planes: Vec<Rounded> = sums.map(|sum| sum.rounded(2.0)).collect();
    if constants.accumulate {
        let (packed, bound) = (slices.shortcut, slices.shortcut_bound[0]);
        let shortcut = packed::unpacked(size, out_channels, packed, bound);
        let sums = planes.iter_mut().zip(shortcut);
        sums.for_each(|(sum, shortcut)| *sum = *sum + Rounded::exact(shortcut));
    }
    PackedOutput { size, channels: out_channels, planes, bound, pixels_alone: true }
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let written = target(params, constants, &slices);
        slices.target_bound[0] = written.bound;
        written.write(slices.target);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let target = target(params, constants, &slices).tolerance(slices.target.len());
        Tolerances { target_bound: Tolerance::Exact, target }
    }
}
