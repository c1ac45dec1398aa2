//! `CIConv` in double precision: the rows pass and its taps.

use super::rounding::UNIT;
use crate::gpu::Reference;
use crate::kernels::ciconv_rows::{Constants, Kernel, Params, Slices, Tolerances};

/// The weights of R, G and B in E, `E_lambda` and `E_lambda_lambda` (Geusebroek et al. 2001).
const COLOR_MODEL: [[f64; 3]; 3] = [[0.06, 0.63, 0.27], [0.30, 0.04, -0.35], [0.34, -0.60, 0.17]];

/// The Gaussian of scale 0.8 and its derivative at -6..=6; the sums of magnitudes are 1.
pub(super) fn taps() -> [[f64; 13]; 2] {
    let sigma = 2.0f64.powf(0.8);
    let bell = |u: f64| (-u * u / (2.0 * sigma * sigma)).exp();
    let normalized = |tap: &dyn Fn(f64) -> f64| {
        let taps: [f64; 13] = std::array::from_fn(|i| tap(i as f64 - 6.0));
        taps.map(|tap| tap / taps.iter().map(|tap| tap.abs()).sum::<f64>())
    };
    [normalized(&bell), normalized(&|u| u * bell(u))]
}

/// One plane correlated with `taps`: `at(u)` is the neighbour at offset `u`, `None` beyond the border.
pub(super) fn correlate(taps: &[f64], at: impl Fn(isize) -> Option<f64>) -> f64 {
    let radius = taps.len() as isize / 2;
    (-radius..=radius).map(|u| taps[(u + radius) as usize] * at(u).unwrap_or(0.0)).sum()
}

/// Both taps on channel `channel` of the colour model about pixel `i`, of what `term` makes of every factor.
fn filtered(
    params: &Params,
    image: &[f32],
    taps: &[[f64; 13]; 2],
    [i, channel]: [usize; 2],
    term: impl Fn(f64) -> f64,
) -> [f64; 2] {
    let (width, pixels) = (params.width as usize, (params.width * params.height) as usize);
    taps.map(|taps| {
        let at = |u: isize| {
            let x = (i % width).checked_add_signed(u).filter(|&x| x < width)?;
            let rgb = |c: usize| f64::from(image[c * pixels + i - i % width + x]);
            Some((0..3).map(|c| term(COLOR_MODEL[channel][c] * rgb(c))).sum())
        };
        correlate(&taps.map(&term), at)
    })
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { image, smooth_rows, slope_rows }: Slices<'_>) {
        let taps = taps();
        for i in 0..(params.width * params.height) as usize {
            for channel in 0..3 {
                let [smooth, slope] = filtered(params, image, &taps, [i, channel], |x| x);
                smooth_rows[i][channel] = smooth as f32;
                slope_rows[i][channel] = slope as f32;
            }
        }
    }

    /// Thirteen products and additions of sums of three: eighteen roundings of the terms' magnitudes, and the
    /// constants'.
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let taps = taps();
        let bounds =
            |at| filtered(params, slices.image, &taps, at, f64::abs).map(|sum| 20.0 * UNIT * sum);
        let numbers = (0..3 * (params.width * params.height) as usize).map(|at| [at / 3, at % 3]);
        let numbers: Vec<_> = numbers.map(bounds).collect();
        let [smooth_rows, slope_rows] = [0, 1].map(|row| numbers.iter().map(|n| n[row]).collect());
        Tolerances { smooth_rows, slope_rows }
    }
}
