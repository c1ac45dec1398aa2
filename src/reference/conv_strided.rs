//! A strided convolution with a ReLU in double precision; the kernel's reference rounds the results.

use super::rounding::UNIT;
use crate::gpu::Reference;
use crate::kernels::conv_strided::{Constants, Kernel, Params, Slices, Tolerances};

/// The sums before the ReLU, or sums of the terms' magnitudes if `term` returns those of the factors.
fn sums(params: &Params, values: &[f32], source: &[f32], term: impl Fn(f64) -> f64) -> Vec<f64> {
    let Params { size, target_size, in_channels, out_channels, window, stride, padding, offset } =
        *params;
    let (inputs, taps) = (in_channels as usize, (window * window) as usize);
    let layer = &values[offset as usize..];
    let biases = &layer[out_channels as usize * inputs * taps..];
    let mut sums = vec![];
    for o in 0..out_channels as usize {
        for (y, x) in (0..target_size.y).flat_map(|y| (0..target_size.x).map(move |x| (y, x))) {
            let mut sum = term(biases[o].into());
            for i in 0..inputs {
                for t in 0..window * window {
                    let at = |pixel: u32, tap: u32| (stride * pixel + tap).checked_sub(padding);
                    let (Some(from_x), Some(from_y)) = (at(x, t % window), at(y, t / window))
                    else {
                        continue;
                    };
                    if from_x < size.x && from_y < size.y {
                        let weight = layer[(o * inputs + i) * taps + t as usize];
                        let from = (i as u32 * size.y + from_y) * size.x + from_x;
                        sum += term(weight.into()) * term(source[from as usize].into());
                    }
                }
            }
            sums.push(sum);
        }
    }
    sums
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { values, source, target }: Slices<'_>) {
        for (target, sum) in target.iter_mut().zip(sums(params, values, source, |x| x)) {
            // A NaN stays one.
            *target = if sum < 0.0 { 0.0 } else { sum as f32 };
        }
    }

    /// One rounding of each term's magnitude, in any order of additions; a ReLU amplifies no error.
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let Slices { values, source, .. } = slices;
        let terms = params.window * params.window * params.in_channels + 2;
        let bound = |magnitude| f64::from(terms) * UNIT * magnitude;
        let magnitudes = sums(params, values, source, f64::abs);
        Tolerances { target: magnitudes.into_iter().map(bound).collect() }
    }
}
