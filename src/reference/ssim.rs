//! SSIM and the gradient of L1 + SSIM, in any number type; the kernel's reference rounds the results.

use glam::UVec2;
use nightsplat_photographs::tone::Real;

use super::inside;
use super::rounding::{Rounded, UNIT, chain, sum_tolerance, write, write_sum};
use crate::gpu::Reference;
use crate::kernels::ssim::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::ssim_window::{C1, C2};

/// SSIM at one pixel of one channel and its derivatives with respect to the blurred moments.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SsimPixel<T> {
    /// The index itself, at most 1.
    pub(super) value: T,
    /// dS/dE\[a\], dS/dE\[aa\], dS/dE\[ab\].
    pub(super) d_moments: [T; 3],
}

/// The 11 x 11 Gaussian window (sigma 1.5) over one channel, zero outside it.
fn blur(width: usize, height: usize, plane: &[f64]) -> Vec<f64> {
    let taps: Vec<f64> = (-5..=5).map(|d| (-f64::from(d * d) / 4.5).exp()).collect();
    let sum: f64 = taps.iter().sum();
    let (mut along_x, mut blurred) = (vec![0.0; plane.len()], vec![0.0; plane.len()]);
    for y in 0..height {
        for x in 0..width {
            for from in x.saturating_sub(5)..width.min(x + 6) {
                along_x[y * width + x] += taps[from + 5 - x] / sum * plane[y * width + from];
            }
        }
    }
    for y in 0..height {
        for x in 0..width {
            for from in y.saturating_sub(5)..height.min(y + 6) {
                blurred[y * width + x] += taps[from + 5 - y] / sum * along_x[from * width + x];
            }
        }
    }
    blurred
}

/// SSIM of every pixel of one channel, `a` against `b`.
pub fn ssim(size: [usize; 2], a: &[f64], b: &[f64]) -> Vec<f64> {
    let [a, b] = [a, b].map(double);
    rounded_ssim(size, &a, &b, |_| true).iter().map(|of| of.value.value).collect()
}

/// Numbers in double precision.
fn double(plane: &[f64]) -> Vec<Rounded> {
    plane.iter().map(|&x| Rounded::from_f64(x)).collect()
}

fn ssim_of_moments<T: Real>(a: T, b: T, aa: T, bb: T, ab: T) -> SsimPixel<T> {
    let [one, two, c1, c2] = [1.0, 2.0, C1, C2].map(T::from_f64);
    let a1 = two * a * b + c1;
    let a2 = two * (ab - a * b) + c2;
    let b1 = a * a + b * b + c1;
    // Variances are not negative: only cancellation of large bright values reaches the floor.
    let b2 = (aa - a * a + bb - b * b).at_least(T::from_f64(0.0)) + c2;
    let scale = one / (b1 * b2);
    let value = a1 * a2 * scale;
    let d_mean = two * (b * (a2 - a1) * scale - a * value * (one / b1 - one / b2));
    SsimPixel { value, d_moments: [d_mean, -value / b2, two * a1 * scale] }
}

/// The gradient of `l1_scale` sum|a - b| - `ssim_scale` sum SSIM with respect to one channel of the render `a`, sums
/// over the pixels from `begin` to before `end`.
pub fn gradient(
    size: [usize; 2],
    loss_region: [UVec2; 2],
    scales: [f64; 2],
    a: &[f64],
    b: &[f64],
) -> Vec<f64> {
    let (scales, [a, b]) = (scales.map(Rounded::from_f64), [a, b].map(double));
    let outcomes = outcomes_of_channel(size, loss_region, scales, &a, &b);
    outcomes.iter().map(|of| of.gradient.value).collect()
}

/// dSSIM/da at one pixel, from the blurred derivatives. A value outside all windows has no gradient, even if it is NaN.
fn d_ssim<T: Real>(a: T, b: T, [mean, square, product]: [T; 3]) -> T {
    let of_square = if square == T::from_f64(0.0) { square } else { T::from_f64(2.0) * a * square };
    mean + of_square + b * product
}

/// The gradient at one pixel, from the blurred derivatives, and |a - b| where it counts.
pub(super) fn rounded_gradient(
    [l1_scale, ssim_scale]: [Rounded; 2],
    a: Rounded,
    b: Rounded,
    d_moments: [Rounded; 3],
    counts: bool,
) -> [Rounded; 2] {
    let difference = if counts { a - b } else { Rounded::default() };
    let value = difference.value;
    let sign = Rounded::from_f64(if value == 0.0 { 0.0 } else { value.signum() });
    let gradient = l1_scale * sign - ssim_scale * d_ssim(a, b, d_moments);
    [gradient, difference.abs()]
}

/// One channel, blurred: each number is a sum of 11 sums of 11 products with rounded taps.
pub(super) fn rounded_blur(size: [usize; 2], plane: &[Rounded]) -> Vec<Rounded> {
    let blurred =
        |of: fn(&Rounded) -> f64| blur(size[0], size[1], &plane.iter().map(of).collect::<Vec<_>>());
    let values = blurred(|x| x.value);
    let errors = blurred(|x| x.error + 26.0 * UNIT * (x.value.abs() + x.error));
    values.into_iter().zip(errors).map(|(value, error)| Rounded { value, error }).collect()
}

/// The results of the kernel for a value of the render.
struct SsimGradient {
    gradient: Rounded,
    /// a - b and SSIM; zero outside the loss region.
    difference: Rounded,
    ssim: Rounded,
}

fn outcomes(params: &Params, slices: &Slices<'_>) -> Vec<SsimGradient> {
    let size = [params.width as usize, params.height as usize];
    let scales = [params.l1_scale, params.ssim_scale].map(Rounded::exact);
    let pixels = size[0] * size[1];
    let channel = |channel: usize| {
        let plane = channel * pixels..(channel + 1) * pixels;
        let [a, b] =
            [slices.render, slices.target].map(|image| Rounded::all(&image[plane.clone()]));
        outcomes_of_channel(size, [params.loss_begin, params.loss_end], scales, &a, &b)
    };
    (0..3).flat_map(channel).collect()
}

/// SSIM of every value of one channel; zero where it does not count.
pub(super) fn rounded_ssim(
    size: [usize; 2],
    a: &[Rounded],
    b: &[Rounded],
    counts: impl Fn(usize) -> bool,
) -> Vec<SsimPixel<Rounded>> {
    let moment = |of: fn(Rounded, Rounded) -> Rounded| {
        let plane: Vec<_> = a.iter().zip(b).map(|(&a, &b)| of(a, b)).collect();
        rounded_blur(size, &plane)
    };
    let means = [moment(|a, _| a), moment(|_, b| b)];
    let squares = [moment(|a, _| a * a), moment(|_, b| b * b), moment(|a, b| a * b)];
    let index = |i: usize| {
        let ([a, b], [aa, bb, ab]) =
            ([0, 1].map(|m| means[m][i]), [0, 1, 2].map(|m| squares[m][i]));
        if counts(i) { ssim_of_moments(a, b, aa, bb, ab) } else { SsimPixel::default() }
    };
    (0..a.len()).map(index).collect()
}

fn outcomes_of_channel(
    size: [usize; 2],
    loss_region: [UVec2; 2],
    scales: [Rounded; 2],
    a: &[Rounded],
    b: &[Rounded],
) -> Vec<SsimGradient> {
    let counts = |i: usize| inside(i, size.map(|side| side as u32), loss_region);
    let map = rounded_ssim(size, a, b, counts);
    let derivatives = [0, 1, 2]
        .map(|m| rounded_blur(size, &map.iter().map(|of| of.d_moments[m]).collect::<Vec<_>>()));
    let outcome = |i: usize| {
        let d = [0, 1, 2].map(|m| derivatives[m][i]);
        let [gradient, difference] = rounded_gradient(scales, a[i], b[i], d, counts(i));
        SsimGradient { gradient, difference, ssim: map[i].value }
    };
    (0..a.len()).map(outcome).collect()
}

/// The gradients, added to those of earlier terms if they are accumulated.
fn accumulated<'a>(
    outcomes: &'a [SsimGradient],
    constants: &Constants,
    before: &'a [f32],
) -> impl Iterator<Item = Rounded> + 'a {
    let adds = constants.adds;
    let sum = move |(of, &before): (&SsimGradient, &f32)| {
        if adds { Rounded::exact(before) + of.gradient } else { of.gradient }
    };
    outcomes.iter().zip(before).map(sum)
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let (outcomes, before) = (outcomes(params, &slices), slices.d_render.to_vec());
        write(accumulated(&outcomes, constants, &before), slices.d_render);
        write_sum(outcomes.iter().map(|of| of.difference.value), slices.l1_partials);
        write_sum(outcomes.iter().map(|of| of.ssim.value), slices.ssim_partials);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let outcomes = outcomes(params, &slices);
        let chain = chain(0) + f64::from(constants.columns * constants.rows);
        Tolerances {
            d_render: accumulated(&outcomes, constants, slices.d_render).collect(),
            l1_partials: sum_tolerance(chain, outcomes.iter().map(|of| of.difference)),
            ssim_partials: sum_tolerance(chain, outcomes.iter().map(|of| of.ssim)),
        }
    }
}
