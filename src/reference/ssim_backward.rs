//! The gradient of L1 + SSIM.

use glam::UVec2;

use super::inside;
use super::rounding::{Rounded, chain, values};
use super::ssim_forward::{blur, rounded_blur, sum_before, target};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::ssim_backward::{Constants, Kernel, Params, Slices, Tolerances};
use crate::tone::Real;

/// The gradient of `l1_scale` sum|a - b| - `ssim_scale` sum SSIM with respect to one channel of the render `a`, sums over
/// the pixels from `begin` to before `end`; `d_moments` are the derivatives that [`super::ssim_forward::ssim`] finds, 0
/// outside.
pub fn gradient(
    [width, height]: [usize; 2],
    interior: [UVec2; 2],
    [l1_scale, ssim_scale]: [f64; 2],
    a: &[f64],
    b: &[f64],
    d_moments: &[[f64; 3]],
) -> Vec<f64> {
    let blurred = [0, 1, 2].map(|m| {
        let plane: Vec<f64> = d_moments.iter().map(|d| d[m]).collect();
        blur(width, height, &plane)
    });
    let at = |i: usize| {
        let counts = inside(i, [width as u32, height as u32], interior);
        let difference = if counts { a[i] - b[i] } else { 0.0 };
        let sign = if difference == 0.0 { 0.0 } else { difference.signum() };
        l1_scale * sign - ssim_scale * d_ssim(a[i], b[i], [0, 1, 2].map(|m| blurred[m][i]))
    };
    (0..a.len()).map(at).collect()
}

/// dSSIM/da at one pixel, from the blurred derivatives.
fn d_ssim<T: Real>(a: T, b: T, [mean, square, product]: [T; 3]) -> T {
    mean + T::of(2.0) * a * square + b * product
}

/// The gradient and a - b of every value of the dispatch's channels.
fn gradients(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
) -> impl Iterator<Item = [Rounded; 2]> {
    let size = [params.width as usize, params.height as usize];
    let interior = [params.interior_begin, params.interior_end];
    let pixels = size[0] * size[1];
    let channels = params.channel_begin as usize..params.channel_end as usize;
    channels.clone().flat_map(move |channel| {
        let plane = channel * pixels..(channel + 1) * pixels;
        let moments = (channel - channels.start) * pixels..(channel + 1 - channels.start) * pixels;
        let b = target(&slices.low[plane.clone()], &slices.tone[0], constants.tone_curve);
        let blurred = [0, 1, 2].map(|m| {
            let derivatives = slices.d_moments[moments.clone()].iter();
            rounded_blur(size, &derivatives.map(|d| Rounded::exact(d[m])).collect::<Vec<_>>())
        });
        let [l1_scale, ssim_scale] = [params.l1_scale, params.ssim_scale].map(Rounded::exact);
        (0..pixels).map(move |i| {
            let a = Rounded::exact(slices.render[plane.start + i]);
            let counts = inside(i, [params.width, params.height], interior);
            let difference = if counts { a - b[i] } else { Rounded::default() };
            let own = difference.value;
            let sign = Rounded {
                value: if own == 0.0 { 0.0 } else { own.signum() },
                // Either one where a rounding of the curve decides.
                error: if difference.error > 0.0 && difference.may_cross(0.0) { 2.0 } else { 0.0 },
            };
            let d_ssim = d_ssim(a, b[i], [0, 1, 2].map(|m| blurred[m][i]));
            [l1_scale * sign - ssim_scale * d_ssim, difference]
        })
    })
}

/// Where the dispatch's channels begin in an image.
fn first_value(params: &Params) -> usize {
    params.channel_begin as usize * params.width as usize * params.height as usize
}

impl Reference for Kernel {
    /// The whole sum goes into the first partial: how many there are is the device's choice.
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let gradients: Vec<_> = gradients(params, constants, &slices).collect();
        let d_render = values(gradients.iter().map(|of| of[0]));
        slices
            .d_render
            .iter_mut()
            .skip(first_value(params))
            .zip(d_render)
            .for_each(|(to, d)| *to = d);
        if params.channel_begin == 0 {
            slices.partials.fill(0.0);
        }
        slices.partials[0] += gradients.iter().map(|of| of[1].value.abs()).sum::<f64>() as f32;
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let gradients: Vec<_> = gradients(params, constants, &slices).collect();
        let chain = chain(0) + f64::from(constants.columns * constants.rows);
        let sum = Rounded::sum(
            chain,
            gradients
                .iter()
                .map(|of| of[1].abs())
                .chain(sum_before(params.channel_begin, slices.partials)),
        );
        Tolerances {
            d_render: std::iter::repeat_n(Rounded::default(), first_value(params))
                .chain(gradients.iter().map(|of| of[0]))
                .collect(),
            partials: Tolerance::Sum(sum.bound()),
        }
    }
}
