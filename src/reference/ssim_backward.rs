//! The gradient of L1 + SSIM in double precision.

use glam::{UVec2, Vec3};

use super::inside;
use super::ssim_forward::{blur, target, widen};
use crate::gpu::Reference;
use crate::kernels::ssim_backward::{Constants, Kernel, Params, Slices};

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
    let sign = |x: f64| if x == 0.0 { 0.0 } else { x.signum() };
    let at = |i: usize| {
        let d_ssim = blurred[0][i] + 2.0 * a[i] * blurred[1][i] + b[i] * blurred[2][i];
        let counts = inside(i, [width as u32, height as u32], interior);
        let difference = if counts { a[i] - b[i] } else { 0.0 };
        l1_scale * sign(difference) - ssim_scale * d_ssim
    };
    (0..a.len()).map(at).collect()
}

impl Reference for Kernel {
    /// The whole sum goes into the first partial: how many there are is the device's choice.
    fn run(
        params: &Params,
        constants: &Constants,
        Slices { render, low, tone, d_moments, d_render, partials }: Slices<'_>,
    ) {
        let size = [params.width as usize, params.height as usize];
        let interior = [params.interior_begin, params.interior_end];
        let scales = [f64::from(params.l1_scale), f64::from(params.ssim_scale)];
        let (a, b) = (widen(render), target(low, &tone[0], constants.tone_curve));
        let d_moments: Vec<_> = d_moments.iter().map(Vec3::as_dvec3).map(Into::into).collect();
        for channel in 0..3 {
            let plane = channel * size[0] * size[1]..(channel + 1) * size[0] * size[1];
            let [a, b] = [&a, &b].map(|image| &image[plane.clone()]);
            let d = gradient(size, interior, scales, a, b, &d_moments[plane.clone()]);
            for (i, d) in plane.zip(d) {
                d_render[i] = d as f32;
            }
        }
        partials.fill(0.0);
        let counts = |&i: &usize| inside(i, [params.width, params.height], interior);
        let sum: f64 = (0..a.len()).filter(counts).map(|i| (a[i] - b[i]).abs()).sum();
        partials[0] = sum as f32;
    }
}
