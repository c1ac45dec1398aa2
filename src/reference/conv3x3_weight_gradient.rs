//! The gradient of the weights and biases of a 3x3 convolution in double precision.

use super::conv3x3::for_each_tap;
use super::ssim_forward::widen;
use crate::gpu::Reference;
use crate::kernels::conv3x3_weight_gradient::{Constants, Kernel, Params, Slices};

/// The gradients of the weights (out, in, 3, 3), then of the biases (out), that the pixels for which `counts` make.
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

impl Reference for Kernel {
    fn run(
        params: &Params,
        constants: &Constants,
        Slices { source, d_target, partials }: Slices<'_>,
    ) {
        let size = params.size.to_array().map(|n| n as usize);
        let channels = [params.in_channels, params.out_channels].map(|n| n as usize);
        let (source, d_target) = (widen(source), widen(d_target));
        let rows = constants.rows as usize;
        let count = channels[1] * (9 * channels[0] + 1);
        for strip in 0..size[1].div_ceil(rows) {
            let counts = |pixel| pixel / size[0] / rows == strip;
            let d_layer = weight_gradient(size, channels, &source, &d_target, counts);
            for i in 0..count {
                partials[strip * count + i] = d_layer[i] as f32;
            }
        }
    }
}
