//! The convolution of `conv3x3` without an activation, in double precision.

use super::conv3x3::{sum_error, sums};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::conv3x3;
use crate::kernels::conv3x3_half::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, Slices { values, source, target }: Slices<'_>) {
        let Params { size, in_channels, out_channels, offset } = *params;
        let Constants { transposed, accumulate, .. } = *constants;
        conv3x3::Kernel::run(
            &conv3x3::Params { size, in_channels, out_channels, offset },
            &conv3x3::Constants { transposed, accumulate, ..Default::default() },
            conv3x3::Slices { values, source, target },
        );
    }

    /// Both factors of a product round by 2^-10 at most, and weights below 2^-22 may vanish; the sum rounds as that of
    /// `conv3x3`.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let Slices { values, source, target } = slices;
        let Params { size, in_channels, out_channels, offset } = *params;
        let params = conv3x3::Params { size, in_channels, out_channels, offset };
        let magnitudes = sums(&params, constants.transposed, values, source, f64::abs);
        let pixels = &source[..(in_channels * size.element_product()) as usize];
        let largest = pixels.iter().fold(0.0, |largest: f64, &x| largest.max(x.abs().into()));
        let vanished = f64::from(9 * in_channels) * largest / 4_194_304.0;
        let bound = |(magnitude, target): (f64, &f32)| {
            let kept = if constants.accumulate { f64::from(target.abs()) } else { 0.0 };
            sum_error(&params, magnitude + kept) + magnitude / 512.0 + vanished
        };
        Tolerances {
            target: Tolerance::Each(magnitudes.into_iter().zip(target.iter()).map(bound).collect()),
        }
    }
}
