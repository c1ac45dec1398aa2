//! The gradient of L1 + SSIM, from the derivatives of SSIM with respect to the blurred moments.

use super::inside;
use super::rounding::{Rounded, chain};
use super::ssim::{rounded_blur, rounded_gradient};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::ssim_backward::{Constants, Kernel, Params, Slices, Tolerances};

/// The gradient of every value, added to that of earlier terms if it is, and |a - b| where it counts.
fn gradients(params: &Params, constants: &Constants, slices: &Slices<'_>) -> Vec<[Rounded; 2]> {
    let size = [params.width as usize, params.height as usize];
    let counts = |i| inside(i, [params.width, params.height], [params.loss_begin, params.loss_end]);
    let pixels = size[0] * size[1];
    let scales = [params.l1_scale, params.ssim_scale].map(Rounded::exact);
    let derivatives = [slices.d_mean, slices.d_square, slices.d_product];
    let of_channel = |channel: usize| {
        let plane = channel * pixels..(channel + 1) * pixels;
        let blurred = derivatives.map(|d| {
            let own: Vec<_> = d[plane.clone()].iter().map(|&x| Rounded::exact(x)).collect();
            rounded_blur(size, &own)
        });
        let [a, b, before] =
            [slices.render, slices.target, &*slices.d_render].map(|image| &image[plane.clone()]);
        let at = move |i: usize| {
            let [a, b] = [a[i], b[i]].map(Rounded::exact);
            let d = [0, 1, 2].map(|m| blurred[m][i]);
            let [gradient, difference] = rounded_gradient(scales, a, b, d, counts(i));
            let sum = Rounded::exact(before[i]) + gradient;
            [if constants.adds { sum } else { gradient }, difference]
        };
        (0..pixels).map(at).collect::<Vec<_>>()
    };
    (0..3).flat_map(of_channel).collect()
}

impl Reference for Kernel {
    /// The whole sum goes into the first partial: the number of partials is chosen by the device.
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let gradients = gradients(params, constants, &slices);
        for (to, [d, _]) in slices.d_render.iter_mut().zip(&gradients) {
            *to = d.value as f32;
        }
        slices.partials.fill(0.0);
        slices.partials[0] = gradients.iter().map(|[_, of]| of.value).sum::<f64>() as f32;
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let gradients = gradients(params, constants, &slices);
        let chain = chain(0) + f64::from(params.rows);
        let sum = Rounded::sum(chain, gradients.iter().map(|&[_, of]| of));
        Tolerances {
            d_render: gradients.iter().map(|&[d, _]| d).collect(),
            partials: Tolerance::Sum(sum.bound()),
        }
    }
}
