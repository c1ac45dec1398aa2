//! The gradient of L1 + SSIM, from the derivatives of SSIM with respect to the blurred moments.

use super::inside;
use super::rounding::{Rounded, chain, sum_tolerance, write, write_sum};
use super::ssim::{rounded_blur, rounded_gradient};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::ssim_backward::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::status::STATUS_NOT_FINITE;

/// The gradient of every value, added to that of earlier terms if it is, and |a - b| where it counts.
fn gradients(params: &Params, constants: &Constants, slices: &Slices<'_>) -> Vec<[Rounded; 2]> {
    let size = [params.width as usize, params.height as usize];
    let counts = |i| inside(i, [params.width, params.height], [params.loss_begin, params.loss_end]);
    let pixels = size[0] * size[1];
    let scales = [params.l1_scale, params.ssim_scale].map(Rounded::exact);
    let derivatives = [slices.d_mean, slices.d_square, slices.d_product];
    let of_channel = |channel: usize| {
        let plane = channel * pixels..(channel + 1) * pixels;
        let blurred = derivatives.map(|d| rounded_blur(size, &Rounded::all(&d[plane.clone()])));
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

/// The means of |a - b| and of SSIM.
fn means(params: &Params, gradients: &[[Rounded; 2]], ssim_partials: &[f32]) -> [Rounded; 2] {
    let strips = params.strips as usize;
    let scale = Rounded::exact(params.mean_scale);
    let differences = gradients.iter().map(|&[_, difference]| difference);
    let l1 = Rounded::sum(chain(strips) + within(params), differences);
    let partials = ssim_partials[..strips].iter().copied().map(Rounded::exact);
    [l1 * scale, Rounded::sum(chain(strips), partials) * scale]
}

/// The most roundings of a term of a strip's sum.
fn within(params: &Params) -> f64 {
    chain(0) + f64::from(params.rows)
}

/// The indices of both terms in the log.
fn logged(params: &Params) -> [usize; 2] {
    [0, 1].map(|term| (params.slot * params.term_count + params.terms[term]) as usize)
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let gradients = gradients(params, constants, &slices);
        let means = means(params, &gradients, slices.ssim_partials);
        let Slices { d_render, l1_partials, log, statuses, status, .. } = slices;
        write(gradients.iter().map(|&[d, _]| d), d_render);
        write_sum(gradients.iter().map(|[_, of]| of.value), l1_partials);
        for (at, mean) in logged(params).into_iter().zip(means) {
            log[at] = mean.value as f32;
            if !log[at].is_finite() {
                status[0] |= STATUS_NOT_FINITE;
            }
        }
        status[3] = status[0];
        statuses[params.slot as usize] = status[0];
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let gradients = gradients(params, constants, &slices);
        let mut log = vec![0.0; slices.log.len()];
        let means = means(params, &gradients, slices.ssim_partials);
        logged(params).into_iter().zip(means).for_each(|(at, mean)| log[at] = mean.bound());
        Tolerances {
            d_render: gradients.iter().map(|&[d, _]| d).collect(),
            l1_partials: sum_tolerance(within(params), gradients.iter().map(|&[_, of]| of)),
            log: Tolerance::Each(log),
            ..Tolerances::default()
        }
    }
}
