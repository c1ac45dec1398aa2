//! The gradient of the weights and biases of a 3x3 convolution in double precision.

use super::conv3x3::for_each_tap;
use super::rounding::UNIT;
use super::widen;
use crate::gpu::Reference;
use crate::kernels::conv3x3_weight_gradient::{Constants, Kernel, Params, Slices, Tolerances};

/// The gradients of the weights (out, in, 3, 3), then of the biases (out), over the pixels for which `counts` is true.
pub fn weight_gradient(
    size: [usize; 2],
    [inputs, outputs]: [usize; 2],
    input: &[f64],
    d_output: &[f64],
    counts: impl Fn(usize) -> bool,
) -> Vec<f64> {
    let pixels = size[0] * size[1];
    let mut d_layer = vec![0.0; outputs * (9 * inputs + 1)];
    let (d_weights, d_biases) = d_layer.split_at_mut(9 * inputs * outputs);
    for o in 0..outputs {
        let d_output = &d_output[o * pixels..][..pixels];
        d_biases[o] = (0..pixels).filter(|&pixel| counts(pixel)).map(|pixel| d_output[pixel]).sum();
        for i in 0..inputs {
            let d_weights = &mut d_weights[9 * (o * inputs + i)..][..9];
            let input = &input[i * pixels..];
            for_each_tap(size, |pixel, tap, from| {
                if counts(pixel) {
                    d_weights[tap] += d_output[pixel] * input[from];
                }
            });
        }
    }
    d_layer
}

/// The gradients of every strip, or sums of magnitudes if `term` returns those of the factors.
pub(super) fn strips(
    params: &Params,
    rows: u32,
    source: &[f32],
    d_target: &[f32],
    term: impl Fn(f64) -> f64,
) -> Vec<f64> {
    let size = params.size.to_array().map(|n| n as usize);
    let channels = [params.in_channels, params.out_channels].map(|n| n as usize);
    let [source, d_target] =
        [(source, channels[0]), (d_target, channels[1])].map(|(values, of)| {
            let values = widen(&values[..of * size[0] * size[1]]);
            values.into_iter().map(&term).collect::<Vec<_>>()
        });
    let rows = rows as usize;
    let strip = |strip| {
        let counts = |pixel| pixel / size[0] / rows == strip;
        weight_gradient(size, channels, &source, &d_target, counts)
    };
    (0..size[1].div_ceil(rows)).flat_map(strip).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { source, d_target, partials } = slices;
        let strips = strips(params, constants.rows, source, d_target, |x| x);
        partials.iter_mut().zip(strips).for_each(|(partial, sum)| *partial = sum as f32);
    }

    /// One rounding per pixel of the strip.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let magnitudes = strips(params, constants.rows, slices.source, slices.d_target, f64::abs);
        let error = f64::from(constants.rows * params.size.x + 2) * UNIT;
        Tolerances { partials: magnitudes.iter().map(|m| error * m).collect() }
    }
}
