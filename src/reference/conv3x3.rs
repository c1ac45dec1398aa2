//! The 3x3 convolution in double precision; the kernel's reference rounds the results.

use super::rounding::UNIT;
use super::widen;
use crate::gpu::Reference;
use crate::kernels::conv3x3::{Constants, Kernel, Params, RELU, SIGMOID, Slices, Tolerances};

/// Calls `visit(pixel, tap, neighbour)` for each of the nine neighbours of each pixel that lie in the image.
pub(super) fn for_each_tap(
    [width, height]: [usize; 2],
    mut visit: impl FnMut(usize, usize, usize),
) {
    for y in 0..height {
        for x in 0..width {
            for tap in 0..9 {
                // One row and one column of padding: indices that wrap around are outside as well.
                let (from_x, from_y) =
                    ((x + tap % 3).wrapping_sub(1), (y + tap / 3).wrapping_sub(1));
                if from_x < width && from_y < height {
                    visit(y * width + x, tap, from_y * width + from_x);
                }
            }
        }
    }
}

/// `output[o](p) = bias[o] + sum over i and t of weight[o, i, t] input[i](p + t)` for images (C, H, W); zero padding.
pub fn conv3x3(
    size: [usize; 2],
    [inputs, outputs]: [usize; 2],
    weights: &[f64],
    biases: &[f64],
    input: &[f64],
) -> Vec<f64> {
    let pixels = size[0] * size[1];
    let mut output: Vec<f64> =
        (0..outputs * pixels).map(|i| biases.get(i / pixels).copied().unwrap_or(0.0)).collect();
    for o in 0..outputs {
        for i in 0..inputs {
            let weights = &weights[9 * (o * inputs + i)..][..9];
            let (input, output) = (&input[i * pixels..], &mut output[o * pixels..]);
            for_each_tap(size, |pixel, tap, from| output[pixel] += weights[tap] * input[from]);
        }
    }
    output
}

/// The gradient of the input of [`conv3x3`], given that of its output.
pub fn data_gradient(
    size: [usize; 2],
    [inputs, outputs]: [usize; 2],
    weights: &[f64],
    d_output: &[f64],
) -> Vec<f64> {
    let pixels = size[0] * size[1];
    let mut d_input = vec![0.0; inputs * pixels];
    for o in 0..outputs {
        for i in 0..inputs {
            let weights = &weights[9 * (o * inputs + i)..][..9];
            let (d_input, d_output) = (&mut d_input[i * pixels..], &d_output[o * pixels..]);
            for_each_tap(size, |pixel, tap, from| d_input[from] += weights[tap] * d_output[pixel]);
        }
    }
    d_input
}

/// The activation of the kernel's constant `ACTIVATION`.
pub fn activate(activation: u32, x: f64) -> f64 {
    match activation {
        // A NaN stays one.
        RELU if x < 0.0 => 0.0,
        SIGMOID => 1.0 / (1.0 + (-x).exp()),
        _ => x,
    }
}

/// The sums before activation, or sums of the terms' magnitudes if `term` returns those of the factors.
pub(super) fn sums(
    params: &Params,
    is_transposed: bool,
    values: &[f32],
    source: &[f32],
    term: impl Fn(f64) -> f64,
) -> Vec<f64> {
    let size = params.size.to_array().map(|n| n as usize);
    let [from, to] = [params.in_channels, params.out_channels].map(|n| n as usize);
    let factors = |values: &[f32]| widen(values).into_iter().map(&term).collect::<Vec<_>>();
    let layer = &values[params.offset as usize..];
    let source = factors(&source[..from * size[0] * size[1]]);
    let weights = factors(&layer[..9 * from * to]);
    if is_transposed {
        data_gradient(size, [to, from], &weights, &source)
    } else {
        conv3x3(size, [from, to], &weights, &factors(&layer[9 * from * to..][..to]), &source)
    }
}

/// The rounding error of a sum of products in any order: one rounding of each term's magnitude.
pub(super) fn sum_error(params: &Params, magnitude: f64) -> f64 {
    f64::from(9 * params.in_channels + 2) * UNIT * magnitude
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, Slices { values, source, target }: Slices<'_>) {
        let sums = sums(params, constants.transposed, values, source, |x| x);
        for (target, sum) in target.iter_mut().zip(sums) {
            let kept = if constants.accumulate { f64::from(*target) } else { 0.0 };
            *target = (kept + activate(constants.activation, sum)) as f32;
        }
    }

    /// No activation amplifies an error; the sigmoid adds those of an exponential, an addition and a division.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let Slices { values, source, target } = slices;
        let magnitudes = sums(params, constants.transposed, values, source, f64::abs);
        let bound = |(magnitude, target): (f64, &f32)| {
            let sigmoid =
                if constants.activation == SIGMOID { (8.0 + 4.0 * magnitude) * UNIT } else { 0.0 };
            let kept = if constants.accumulate { f64::from(target.abs()) } else { 0.0 };
            sum_error(params, magnitude) + sigmoid + 2.0 * UNIT * (magnitude + kept)
        };
        Tolerances { target: magnitudes.into_iter().zip(target.iter()).map(bound).collect() }
    }
}
