//! `CIConv` in double precision: what the rows pass leaves, and its taps.

use crate::gpu::Reference;
use crate::kernels::ciconv_rows::{Constants, Kernel, Params, Slices};

/// What R, G and B add to E, `E_lambda` and `E_lambda_lambda` (Geusebroek et al. 2001).
const COLOR_MODEL: [[f64; 3]; 3] = [[0.06, 0.63, 0.27], [0.30, 0.04, -0.35], [0.34, -0.60, 0.17]];

/// The Gaussian of scale 0.8 and its derivative at -6..=6; the sums of magnitudes are 1.
pub(super) fn taps() -> [Vec<f64>; 2] {
    let sigma = 2.0f64.powf(0.8);
    let radius = (3.0 * sigma + 0.5).ceil() as i32;
    let bell = |u: i32| (-f64::from(u * u) / (2.0 * sigma * sigma)).exp();
    let normalized = |tap: &dyn Fn(i32) -> f64| {
        let sum: f64 = (-radius..=radius).map(|u| tap(u).abs()).sum();
        (-radius..=radius).map(|u| tap(u) / sum).collect()
    };
    [normalized(&bell), normalized(&|u| f64::from(u) * bell(u))]
}

/// One plane correlated with `taps`: `at(u)` is the neighbour `u` away, none beyond the border.
pub(super) fn correlate(taps: &[f64], at: impl Fn(isize) -> Option<f64>) -> f64 {
    let radius = taps.len() as isize / 2;
    (-radius..=radius).map(|u| taps[(u + radius) as usize] * at(u).unwrap_or(0.0)).sum()
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let (width, height) = (params.width as usize, params.height as usize);
        let pixels = width * height;
        let [smooth, slope] = taps();
        for i in 0..pixels {
            for (channel, row) in COLOR_MODEL.iter().enumerate() {
                let at = |u: isize| {
                    let x = (i % width).checked_add_signed(u).filter(|&x| x < width)?;
                    let rgb = |c: usize| f64::from(slices.image[c * pixels + i - i % width + x]);
                    Some((0..3).map(|c| row[c] * rgb(c)).sum())
                };
                slices.smooth_rows[i][channel] = correlate(&smooth, at) as f32;
                slices.slope_rows[i][channel] = correlate(&slope, at) as f32;
            }
        }
    }
}
