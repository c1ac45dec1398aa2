//! The partial sums of `conv3x3_weight_gradient`, in double precision.

use super::conv3x3_weight_gradient::strips;
use super::rounding::UNIT;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::conv3x3_weight_gradient;
use crate::kernels::conv3x3_weight_gradient_half::{Constants, Kernel, Params, Slices, Tolerances};

fn single(params: &Params) -> conv3x3_weight_gradient::Params {
    let Params { size, in_channels, out_channels } = *params;
    conv3x3_weight_gradient::Params { size, in_channels, out_channels }
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { source, d_target, partials } = slices;
        let strips = strips(&single(params), constants.rows, source, d_target, |x| x);
        partials.iter_mut().zip(strips).for_each(|(partial, sum)| *partial = sum as f32);
    }

    /// Both factors of a product round by 2^-10 at most, and what is below 2^-28 of a strip's largest may vanish. The sums
    /// round as those of `conv3x3_weight_gradient`; those of biases no more than that.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let Slices { source, d_target, .. } = slices;
        let Params { size, in_channels, out_channels } = *params;
        let magnitudes = strips(&single(params), constants.rows, source, d_target, f64::abs);
        let pixels_of_strip = f64::from(constants.rows * size.x);
        let largest = |factor: &[f32], channels: u32| {
            let own = &factor[..(channels * size.element_product()) as usize];
            own.iter().fold(0.0, |largest: f64, &x| largest.max(x.abs().into()))
        };
        let both = largest(source, in_channels) * largest(d_target, out_channels);
        let vanished = 2.0 * pixels_of_strip * both * f64::exp2(-28.0);
        let weights = (9 * in_channels * out_channels) as usize;
        let of_strip = weights + out_channels as usize;
        let bound = |(i, &magnitude): (usize, &f64)| {
            let of_factors =
                if i % of_strip < weights { magnitude / 512.0 + vanished } else { 0.0 };
            (pixels_of_strip + 2.0) * UNIT * magnitude + of_factors
        };
        Tolerances { partials: Tolerance::Each(magnitudes.iter().enumerate().map(bound).collect()) }
    }
}
