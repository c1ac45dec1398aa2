//! Estimates sensor noise from the flat parts of photographs.
//!
//! ```text
//! variance = gain * signal + read^2        in linear light, of one channel of one pixel
//! ```
//!
//! The variance of shot noise is proportional to the light, that of read noise is constant: a line in linear light, so
//! photographs are linearised first. The variance of quantisation is known and subtracted.
//!
//! Second differences along rows cancel brightness and gradients; for white noise their mean square is six variances.
//! The flatness of a patch is judged by the means of 2x2 pixels, which are nearly independent of the second
//! differences, so that choosing flat patches does not bias their noise.

use serde::Serialize;

/// Side of a patch in pixels.
const SIDE: usize = 8;
/// The fraction of the patches of one brightness that count as flat.
const FLAT: f64 = 0.25;
/// Bins of brightness for the fit of the line.
const BINS: usize = 24;
/// The fewest flat patches of a bin.
const MIN_PATCHES: usize = 12;
/// Patches with less than this fraction of the quantisation's variance have lost their noise to compression or coarse
/// codes.
const DEAD: f64 = 0.25;
/// Above this fraction of black values, noise is clipped at zero and underestimated.
const MAX_ZEROS: f64 = 0.002;

/// The noise of a channel in linear light; white is 1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ChannelNoise {
    /// Variance per signal; for pure shot noise, 1 / the electrons of a white pixel.
    pub gain: f64,
    /// Standard deviation in the dark.
    pub read: f64,
}

impl ChannelNoise {
    /// The standard deviation at a signal, in linear light.
    pub fn deviation(&self, signal: f64) -> f64 {
        (self.gain * signal.max(0.0) + self.read * self.read).sqrt()
    }
}

/// A small square of one channel.
#[derive(Clone, Copy, Debug)]
pub(super) struct NoisePatch {
    /// Its mean, in linear light.
    signal: f64,
    /// The variance of its noise, if it is flat.
    variance: f64,
    /// The variance of the means of 2x2 pixels.
    texture: f64,
    /// The variance of quantisation.
    quantization: f64,
    /// The fraction of its values that are 0.
    zeros: f64,
}

/// The patches of a plane of linear values in rows of `width`; codes are `step` apart in encoded values. All patches if
/// there are few, else an even selection.
pub(super) fn patches(plane: &[f32], width: usize, step: f64) -> Vec<NoisePatch> {
    const MOST: usize = 12_000;
    let (columns, rows) = (width / SIDE, plane.len() / width.max(1) / SIDE);
    let stride = (columns * rows).div_ceil(MOST).max(1);
    let indices = (0..columns * rows).step_by(stride);
    let patch = |index: usize| {
        let first = index / columns * SIDE * width + index % columns * SIDE;
        let row = |y: usize| &plane[first + y * width..][..SIDE];
        patch(std::array::from_fn(row), step)
    };
    // A patch that reaches white is clipped.
    indices.map(patch).filter(|patch| patch.signal.is_finite()).collect()
}

fn patch(rows: [&[f32]; SIDE], step: f64) -> NoisePatch {
    let count = (SIDE * SIDE) as f64;
    let (mut sum, mut zeros, mut is_clipped) = (0.0, 0, false);
    for &value in rows.into_iter().flatten() {
        sum += f64::from(value);
        zeros += u32::from(value <= 0.0);
        is_clipped |= value >= 1.0;
    }
    let signal = if is_clipped { f64::NAN } else { sum / count };
    let curved = |of: &[f32]| f64::from(of[0] - 2.0 * of[1] + of[2]).powi(2);
    let squares: f64 = rows.iter().flat_map(|row| row.windows(3).map(curved)).sum();
    let mut squared_means = 0.0;
    for two in rows.chunks_exact(2) {
        for (above, below) in two[0].chunks_exact(2).zip(two[1].chunks_exact(2)) {
            squared_means += (f64::from(above[0] + above[1] + below[0] + below[1]) / 4.0).powi(2);
        }
    }
    NoisePatch {
        signal,
        variance: squares / (SIDE * (SIDE - 2)) as f64 / 6.0,
        texture: squared_means / (count / 4.0) - signal * signal,
        quantization: (step * slope(signal)).powi(2) / 12.0,
        zeros: f64::from(zeros) / count,
    }
}

/// Linear light per encoded value at a linear value.
pub(super) fn slope(linear: f64) -> f64 {
    if linear <= 0.003_130_8 { 1.0 / 12.92 } else { 2.4 / 1.055 * linear.powf(1.4 / 2.4) }
}

/// Fits the line to the flat patches; `None` if there are too few.
pub(super) fn fit(mut patches: Vec<NoisePatch>) -> Option<ChannelNoise> {
    // A plane without quantisation has no dead patches.
    patches.retain(|patch| patch.variance >= DEAD * patch.quantization);
    patches.sort_unstable_by(|a, b| a.signal.total_cmp(&b.signal));
    let per_bin = patches.len().div_ceil(BINS).max((MIN_PATCHES as f64 / FLAT) as usize);
    let mut bins: Vec<Bin> = patches.chunks_mut(per_bin).filter_map(Bin::new).collect();
    // If noise is clipped in every bin, use what is left.
    if bins.iter().any(|bin| bin.zeros <= MAX_ZEROS) {
        bins.retain(|bin| bin.zeros <= MAX_ZEROS);
    }
    (!bins.is_empty()).then(|| line(&bins))
}

/// The patches of one brightness.
struct Bin {
    signal: f64,
    variance: f64,
    count: f64,
    zeros: f64,
}

impl Bin {
    fn new(patches: &mut [NoisePatch]) -> Option<Self> {
        let zeros = patches.iter().map(|patch| patch.zeros).sum::<f64>() / patches.len() as f64;
        let flat = (patches.len() as f64 * FLAT) as usize;
        if flat < MIN_PATCHES {
            return None;
        }
        let (flat, ..) =
            patches.select_nth_unstable_by(flat, |a, b| a.texture.total_cmp(&b.texture));
        let mean =
            |of: fn(&NoisePatch) -> f64| flat.iter().map(of).sum::<f64>() / flat.len() as f64;
        let variance = mean(|patch| patch.variance - patch.quantization);
        let count = flat.len() as f64;
        Some(Self { signal: mean(|patch| patch.signal), variance, count, zeros })
    }
}

/// Least squares with non-negative coefficients. The error of a variance is proportional to it, so each bin is weighted
/// by its patches over the square of the line's value.
fn line(bins: &[Bin]) -> ChannelNoise {
    const ROUNDS: usize = 8;
    let mean = bins.iter().map(|bin| bin.variance.max(0.0)).sum::<f64>() / bins.len() as f64;
    let floor = (0.01 * mean).max(1e-18);
    let (mut gain, mut square) = (0.0, mean);
    for _ in 0..ROUNDS {
        let mut sums = [0.0; 5];
        for Bin { signal, variance, count, .. } in bins {
            let weight = count / (gain * signal + square).max(floor).powi(2);
            let terms = [1.0, *signal, signal * signal, *variance, signal * variance];
            sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += weight * term);
        }
        let [ones, s, ss, v, sv] = sums;
        let determinant = ones * ss - s * s;
        (gain, square) = ((ones * sv - s * v) / determinant, (ss * v - s * sv) / determinant);
        // A single brightness has no slope.
        if !(determinant > 1e-9 * ones * ss && square >= 0.0) {
            (gain, square) = (sv / ss, 0.0);
        } else if gain < 0.0 {
            (gain, square) = (0.0, v / ones);
        }
    }
    ChannelNoise { gain: gain.max(0.0), read: square.max(0.0).sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nightsplat_core::random::Stream;

    const WIDTH: usize = 512;

    /// Stripes of brightness with noise, and texture in every second patch.
    fn plane(noise: ChannelNoise, textured: bool) -> Vec<f32> {
        let (width, height) = (WIDTH, 512);
        let stream = Stream::new(4, 0);
        let value = |index: usize| {
            let (x, y) = (index % width, index / width);
            let mut signal = 0.02 + 0.3 * (y / SIDE) as f64 / 64.0;
            if textured && (x / SIDE).is_multiple_of(2) {
                signal *= 0.7 + 0.3 * f64::from((x % 3) as u32);
            }
            (signal + noise.deviation(signal) * stream.normal(index as u64)) as f32
        };
        (0..width * height).map(value).collect()
    }

    #[test]
    fn gain_and_read_noise_are_found_in_textured_photographs() {
        let injected = ChannelNoise { gain: 2e-4, read: 3e-3 };
        for textured in [false, true] {
            let found = fit(patches(&plane(injected, textured), WIDTH, 0.0)).unwrap();
            assert!((found.gain / injected.gain - 1.0).abs() < 0.1, "{textured} {found:?}");
            assert!((found.read / injected.read - 1.0).abs() < 0.1, "{textured} {found:?}");
        }
    }

    #[test]
    fn a_clean_plane_has_no_noise_and_one_without_patches_no_estimate() {
        let found = fit(patches(&plane(ChannelNoise::default(), true), WIDTH, 0.0)).unwrap();
        assert!(found.deviation(0.3) < 1e-4, "{found:?}");
        assert_eq!(fit(patches(&[0.5; 30], 6, 0.0)), None);
        assert_eq!(fit(vec![]), None);
    }

    #[test]
    fn the_slope_is_the_derivative_of_the_transfer_function() {
        for linear in [0.001, 0.02, 0.4] {
            let encoded = |linear: f64| {
                f64::from(nightsplat_photographs::image::srgb_from_linear(linear as f32))
            };
            let numeric =
                (1.01 * linear - 0.99 * linear) / (encoded(1.01 * linear) - encoded(0.99 * linear));
            assert!((slope(linear) / numeric - 1.0).abs() < 1e-2, "{linear}");
        }
    }
}
