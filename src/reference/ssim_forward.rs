//! SSIM in double precision; the kernel's reference rounds what it returns.

use glam::Vec3;

use super::inside;
use crate::gpu::Reference;
use crate::kernels::ToneParameters;
use crate::kernels::ssim_forward::{C1, C2, Constants, Kernel, Params, Slices};
use crate::tone::tone_curve;

/// SSIM at one pixel of one channel and its derivatives with respect to the blurred moments.
#[derive(Clone, Copy, Debug)]
pub struct Ssim {
    /// The index itself, at most 1.
    pub value: f64,
    /// dS/dE\[a\], dS/dE\[aa\], dS/dE\[ab\].
    pub d_moments: [f64; 3],
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

fn ssim_of_moments(a: f64, b: f64, aa: f64, bb: f64, ab: f64) -> Ssim {
    let a1 = 2.0 * a * b + C1;
    let a2 = 2.0 * (ab - a * b) + C2;
    let b1 = a * a + b * b + C1;
    let b2 = (aa - a * a + bb - b * b).max(0.0) + C2;
    let value = a1 * a2 / (b1 * b2);
    let d_mean = 2.0 * b * (a2 - a1) / (b1 * b2) - 2.0 * a * value * (1.0 / b1 - 1.0 / b2);
    Ssim { value, d_moments: [d_mean, -value / b2, 2.0 * a1 / (b1 * b2)] }
}

/// The pseudo-GT of a photograph.
pub(super) fn target(low: &[f32], tone_parameters: &ToneParameters, curve: u32) -> Vec<f64> {
    low.iter().map(|&x| f64::from(tone_curve(curve, x, tone_parameters))).collect()
}

pub(super) fn widen(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&x| f64::from(x)).collect()
}

impl Reference for Kernel {
    /// The whole sum goes into the first partial: how many there are is the device's choice.
    fn run(
        params: &Params,
        constants: &Constants,
        Slices { render, low, tone, d_moments, partials }: Slices<'_>,
    ) {
        let (width, height) = (params.width as usize, params.height as usize);
        let (a, b) = (widen(render), target(low, &tone[0], constants.tone_curve));
        let mut sum = 0.0;
        for channel in 0..3 {
            let plane = channel * width * height..(channel + 1) * width * height;
            let map = ssim(width, height, &a[plane.clone()], &b[plane.clone()]);
            for (i, ssim) in plane.zip(map) {
                let counts = inside(
                    i,
                    [params.width, params.height],
                    [params.interior_begin, params.interior_end],
                );
                let d = if counts { ssim.d_moments } else { [0.0; 3] };
                d_moments[i] = Vec3::from_array(d.map(|d| d as f32));
                sum += if counts { ssim.value } else { 0.0 };
            }
        }
        partials.fill(0.0);
        partials[0] = sum as f32;
    }
}
