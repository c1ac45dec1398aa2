//! SSIM, in any number; the kernel's reference rounds what it returns.

use glam::Vec3;

use super::inside;
use super::rounding::{Rounded, UNIT, chain, rounded_tone_curve};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::ToneParameters;
use crate::kernels::ssim_forward::{C1, C2, Constants, Kernel, Params, Slices, Tolerances};
use crate::tone::Real;

/// SSIM at one pixel of one channel and its derivatives with respect to the blurred moments.
#[derive(Clone, Copy, Debug)]
pub struct Ssim<T = f64> {
    /// The index itself, at most 1.
    pub value: T,
    /// dS/dE\[a\], dS/dE\[aa\], dS/dE\[ab\].
    pub d_moments: [T; 3],
}

/// The 11 x 11 Gaussian window (sigma 1.5) over one channel, zero outside it.
pub fn blur(width: usize, height: usize, plane: &[f64]) -> Vec<f64> {
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
pub fn ssim(width: usize, height: usize, a: &[f64], b: &[f64]) -> Vec<Ssim> {
    let moment = |of: fn(f64, f64) -> f64| {
        let plane: Vec<f64> = a.iter().zip(b).map(|(&a, &b)| of(a, b)).collect();
        blur(width, height, &plane)
    };
    let (mean_a, mean_b) = (moment(|a, _| a), moment(|_, b| b));
    let (aa, bb, ab) = (moment(|a, _| a * a), moment(|_, b| b * b), moment(|a, b| a * b));
    (0..a.len()).map(|i| ssim_of_moments(mean_a[i], mean_b[i], aa[i], bb[i], ab[i])).collect()
}

fn ssim_of_moments<T: Real>(a: T, b: T, aa: T, bb: T, ab: T) -> Ssim<T> {
    let [one, two, c1, c2] = [1.0, 2.0, C1, C2].map(T::of);
    let a1 = two * a * b + c1;
    let a2 = two * (ab - a * b) + c2;
    let b1 = a * a + b * b + c1;
    // The variances are not negative: only the cancellation of large bright values reaches the floor.
    let b2 = (aa - a * a + bb - b * b).at_least(T::of(0.0)) + c2;
    let scale = one / (b1 * b2);
    let value = a1 * a2 * scale;
    let d_mean = two * (b * (a2 - a1) * scale - a * value * (one / b1 - one / b2));
    Ssim { value, d_moments: [d_mean, -value / b2, two * a1 * scale] }
}

/// One channel, blurred: each number is a sum of 11 sums of 11 products with rounded taps.
pub(super) fn rounded_blur(size: [usize; 2], plane: &[Rounded]) -> Vec<Rounded> {
    let blurred =
        |of: fn(&Rounded) -> f64| blur(size[0], size[1], &plane.iter().map(of).collect::<Vec<_>>());
    let values = blurred(|x| x.value);
    let errors = blurred(|x| x.error + 26.0 * UNIT * (x.value.abs() + x.error));
    values.into_iter().zip(errors).map(|(value, error)| Rounded { value, error }).collect()
}

/// The pseudo-GT of a photograph.
pub(super) fn target(low: &[f32], tone: &ToneParameters, curve: u32) -> Vec<Rounded> {
    low.iter().map(|&x| rounded_tone_curve(curve, x, tone)).collect()
}

pub(super) fn widen(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&x| f64::from(x)).collect()
}

/// The index and the derivatives of every value of the dispatch's channels; zero where it does not count.
fn indices(params: &Params, constants: &Constants, slices: &Slices<'_>) -> Vec<Ssim<Rounded>> {
    let size = [params.width as usize, params.height as usize];
    let interior = [params.interior_begin, params.interior_end];
    let pixels = size[0] * size[1];
    let channel = |channel: usize| {
        let plane = channel * pixels..(channel + 1) * pixels;
        let a: Vec<_> = slices.render[plane.clone()].iter().copied().map(Rounded::exact).collect();
        let b = target(&slices.low[plane], &slices.tone[0], constants.tone_curve);
        let moment = |of: fn(Rounded, Rounded) -> Rounded| {
            let plane: Vec<_> = a.iter().zip(&b).map(|(&a, &b)| of(a, b)).collect();
            rounded_blur(size, &plane)
        };
        let means = [moment(|a, _| a), moment(|_, b| b)];
        let squares = [moment(|a, _| a * a), moment(|_, b| b * b), moment(|a, b| a * b)];
        (0..pixels).map(move |i| {
            let counts = inside(i, [params.width, params.height], interior);
            if !counts {
                return Ssim { value: Rounded::default(), d_moments: [Rounded::default(); 3] };
            }
            let ([a, b], [aa, bb, ab]) =
                ([0, 1].map(|m| means[m][i]), [0, 1, 2].map(|m| squares[m][i]));
            ssim_of_moments(a, b, aa, bb, ab)
        })
    };
    (params.channel_begin as usize..params.channel_end as usize).flat_map(channel).collect()
}

/// What the partial sums of the channels of earlier dispatches hold.
pub(super) fn sum_before(channel_begin: u32, partials: &[f32]) -> impl Iterator<Item = Rounded> {
    let before = if channel_begin > 0 { partials } else { &[] };
    before.iter().map(|&partial| Rounded::exact(partial.abs()))
}

impl Reference for Kernel {
    /// The whole sum goes into the first partial: how many there are is the device's choice.
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let indices = indices(params, constants, &slices);
        for (d_moments, of) in slices.d_moments.iter_mut().zip(&indices) {
            *d_moments = Vec3::from_array(of.d_moments.map(|d| d.value as f32));
        }
        if params.channel_begin == 0 {
            slices.partials.fill(0.0);
        }
        slices.partials[0] += indices.iter().map(|of| of.value.value).sum::<f64>() as f32;
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let indices = indices(params, constants, &slices);
        let chain = chain(0) + f64::from(constants.columns * constants.rows);
        let sum = Rounded::sum(
            chain,
            indices
                .iter()
                .map(|of| of.value)
                .chain(sum_before(params.channel_begin, slices.partials)),
        );
        Tolerances {
            d_moments: indices.iter().flat_map(|of| of.d_moments).collect(),
            partials: Tolerance::Sum(sum.bound()),
        }
    }
}
