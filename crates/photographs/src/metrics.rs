//! Scores of a render against its reference image: PSNR and SSIM, in f64, on sRGB-encoded values with peak 1.

use std::borrow::Cow;

use nightsplat_core::{Error, Result};
use rayon::prelude::*;

use crate::image::{Image, Mask};

/// The scores of a render, or means over several.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Scores {
    /// PSNR of the mean squared error over all channels, dB.
    pub psnr: f64,
    /// The mean of the three channels' PSNRs, dB.
    pub psnr_channel_mean: f64,
    /// Mean structural similarity.
    pub ssim: f64,
}

impl Scores {
    /// Every score of `render` against `reference`.
    ///
    /// # Errors
    /// [`Error::Usage`] if the images differ in size.
    pub fn measure(render: &Image, reference: &Image) -> Result<Self> {
        Self::of_counted(render, reference, None)
    }

    /// Every score of the unmasked pixels; see [`counted`].
    #[doc(hidden)]
    pub fn of_counted(render: &Image, reference: &Image, mask: Option<&Mask>) -> Result<Self> {
        let mask = mask.map(|mask| mask.resized(render.width, render.height));
        let mask = mask.as_deref();
        let errors = errors(render, reference, mask)?;
        Ok(Self {
            psnr: decibels(mean(&errors)),
            psnr_channel_mean: mean(&errors.map(decibels)),
            ssim: mean_ssim(&counted(render, reference, mask), reference, mask)?,
        })
    }

    /// Mean of each score; `None` if empty.
    #[doc(hidden)]
    pub fn mean(scores: &[Self]) -> Option<Self> {
        let mean =
            |score: fn(&Self) -> f64| scores.iter().map(score).sum::<f64>() / scores.len() as f64;
        (!scores.is_empty()).then(|| Self {
            psnr: mean(|scores| scores.psnr),
            psnr_channel_mean: mean(|scores| scores.psnr_channel_mean),
            ssim: mean(|scores| scores.ssim),
        })
    }
}

/// The render with the reference at masked pixels: a metric with a window sees no difference there.
pub fn counted<'a>(render: &'a Image, reference: &Image, mask: Option<&Mask>) -> Cow<'a, Image> {
    let Some(mask) = mask else { return Cow::Borrowed(render) };
    let weights = mask.weights.iter().cycle();
    let shown = render.data.iter().zip(&reference.data).zip(weights);
    let data = shown.map(|((&a, &b), &w)| w * a + (1.0 - w) * b).collect();
    Cow::Owned(Image { data, ..*render })
}

/// Peak signal-to-noise ratio over all pixels and channels, dB; infinite for equal images.
pub fn psnr(render: &Image, reference: &Image) -> Result<f64> {
    psnr_of_counted(render, reference, None)
}

/// Peak signal-to-noise ratio of the unmasked pixels over all channels, dB; infinite for equal images.
pub fn psnr_of_counted(render: &Image, reference: &Image, mask: Option<&Mask>) -> Result<f64> {
    let mask = mask.map(|mask| mask.resized(render.width, render.height));
    Ok(decibels(mean(&errors(render, reference, mask.as_deref())?)))
}

/// The mean of the PSNRs of the three channels, dB: as the paper's code computes it, never below [`psnr`].
pub fn psnr_channel_mean(render: &Image, reference: &Image) -> Result<f64> {
    Ok(mean(&errors(render, reference, None)?.map(decibels)))
}

/// Mean structural similarity over all pixels and channels (Wang et al. 2004): an 11x11 Gaussian window with sigma 1.5
/// and zero padding, C1 = 0.01^2, C2 = 0.03^2, as in 3DGS.
pub fn ssim(render: &Image, reference: &Image) -> Result<f64> {
    mean_ssim(render, reference, None)
}

/// Mean structural similarity with a uniform window of 7x7 and sample covariances, over the pixels whose window lies in
/// the image and the channels: the default of scikit-image's `structural_similarity`, and the protocol of `RealX3D`.
pub fn ssim_uniform(render: &Image, reference: &Image) -> Result<f64> {
    if render.width.min(render.height) < UNIFORM_SIDE as u32 {
        let (width, height) = (render.width, render.height);
        return Err(Error::Usage(format!(
            "an image of {width}x{height} has no window of {UNIFORM_SIDE}x{UNIFORM_SIDE}; leave out --uniform-ssim"
        )));
    }
    let (pairs, width) = (channels(render, reference)?, render.width as usize);
    let of_channel = |(a, b)| {
        const COUNT: f64 = (UNIFORM_SIDE * UNIFORM_SIDE) as f64;
        mean(&ssim_map(a, b, |plane| window_means(plane, width), COUNT / (COUNT - 1.0)))
    };
    Ok(mean(&pairs.into_par_iter().map(of_channel).collect::<Vec<f64>>()))
}

/// The mean over the channels of that over the unmasked pixels.
fn mean_ssim(render: &Image, reference: &Image, mask: Option<&Mask>) -> Result<f64> {
    let (pairs, width) = (channels(render, reference)?, render.width as usize);
    let ssim = pairs
        .into_par_iter()
        .map(|(a, b)| mean_of_counted(&ssim_map(a, b, |plane| blur(plane, width), 1.0), mask));
    Ok(mean(&ssim.collect::<Vec<f64>>()))
}

/// The three pairs of planes, (H, W) each.
fn channels<'a>(render: &'a Image, reference: &'a Image) -> Result<[(&'a [f32], &'a [f32]); 3]> {
    let size = |image: &Image| (image.width as usize, image.height as usize);
    let ((width, height), other) = (size(render), size(reference));
    if (width, height) != other {
        return Err(Error::Usage(format!(
            "the render is {width}x{height} and the reference {}x{}; they must have the same size",
            other.0, other.1
        )));
    }
    let pixels = width * height;
    if pixels == 0 || render.data.len() != 3 * pixels || reference.data.len() != 3 * pixels {
        return Err(Error::Usage("an image without pixels cannot be compared".to_owned()));
    }
    let plane = |channel: usize| channel * pixels..(channel + 1) * pixels;
    Ok([0, 1, 2].map(|channel| (&render.data[plane(channel)], &reference.data[plane(channel)])))
}

/// The mean squared error of each channel over the unmasked pixels.
fn errors(render: &Image, reference: &Image, mask: Option<&Mask>) -> Result<[f64; 3]> {
    if mask.is_some_and(Mask::hides_all) {
        let problem = "a mask that hides every pixel leaves none to compare";
        return Err(Error::Usage(problem.to_owned()));
    }
    let squared = |(&a, &b): (&f32, &f32)| (f64::from(a) - f64::from(b)).powi(2);
    let of_channel = |(a, b): (&[f32], &[f32])| {
        let squares: Vec<f64> = a.iter().zip(b).map(squared).collect();
        mean_of_counted(&squares, mask)
    };
    Ok(channels(render, reference)?.map(of_channel))
}

/// The mean over the unmasked pixels.
fn mean_of_counted(values: &[f64], mask: Option<&Mask>) -> f64 {
    let Some(mask) = mask else { return mean(values) };
    let weights = || mask.weights.iter().copied().map(f64::from);
    let weighted = values.iter().zip(weights()).map(|(value, weight)| value * weight);
    weighted.sum::<f64>() / weights().sum::<f64>()
}

fn decibels(mean_squared_error: f64) -> f64 {
    -10.0 * mean_squared_error.log10()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// SSIM of every pixel, from the means over its window; `unbias` is the factor on variances and covariances.
fn ssim_map(
    a: &[f32],
    b: &[f32],
    window_means: impl Fn(&[f64]) -> Vec<f64>,
    unbias: f64,
) -> Vec<f64> {
    const C1: f64 = 0.01 * 0.01;
    const C2: f64 = 0.03 * 0.03;
    let blurred = |value: fn(f64, f64) -> f64| {
        window_means(&a.iter().zip(b).map(|(&a, &b)| value(a.into(), b.into())).collect::<Vec<_>>())
    };
    let (mean_a, mean_b) = (blurred(|a, _| a), blurred(|_, b| b));
    let (square_a, square_b, product) =
        (blurred(|a, _| a * a), blurred(|_, b| b * b), blurred(|a, b| a * b));
    let ssim = |i: usize| {
        let (mean_a, mean_b) = (mean_a[i], mean_b[i]);
        let variance = |square: f64, mean: f64| unbias * (square - mean * mean);
        let (var_a, var_b) = (variance(square_a[i], mean_a), variance(square_b[i], mean_b));
        let cov = unbias * (product[i] - mean_a * mean_b);
        let luminance = (2.0 * mean_a * mean_b + C1) / (mean_a * mean_a + mean_b * mean_b + C1);
        luminance * (2.0 * cov + C2) / (var_a + var_b + C2)
    };
    (0..mean_a.len()).map(ssim).collect()
}

/// The side of the uniform window.
const UNIFORM_SIDE: usize = 7;

/// The mean over every uniform window that lies in a plane of rows of `width`.
fn window_means(plane: &[f64], width: usize) -> Vec<f64> {
    let sums = |row: &[f64]| -> Vec<f64> {
        row.windows(UNIFORM_SIDE).map(|window| window.iter().sum()).collect()
    };
    let rows: Vec<Vec<f64>> = plane.chunks_exact(width).map(sums).collect();
    let mean = |rows: &[Vec<f64>], column: usize| {
        rows.iter().map(|row| row[column]).sum::<f64>() / (UNIFORM_SIDE * UNIFORM_SIDE) as f64
    };
    let columns = 0..width + 1 - UNIFORM_SIDE;
    rows.windows(UNIFORM_SIDE)
        .flat_map(|rows| columns.clone().map(move |column| mean(rows, column)))
        .collect()
}

/// Taps of the window on either side of the centre.
const RADIUS: usize = 5;

/// The normalised 1D window.
fn window() -> [f64; 2 * RADIUS + 1] {
    const SIGMA: f64 = 1.5;
    let tap = |i: usize| (-(i as f64 - RADIUS as f64).powi(2) / (2.0 * SIGMA * SIGMA)).exp();
    let taps: [f64; 2 * RADIUS + 1] = std::array::from_fn(tap);
    taps.map(|value| value / taps.iter().sum::<f64>())
}

/// Convolves a plane of rows of `width` with the window, zero outside: first down the columns, then along the rows.
fn blur(plane: &[f64], width: usize) -> Vec<f64> {
    let (window, height) = (window(), plane.len() / width);
    let mut blurred = vec![0.0; plane.len()];
    let mut column_sums = vec![0.0; width + 2 * RADIUS];
    for (y, out) in blurred.chunks_exact_mut(width).enumerate() {
        column_sums.fill(0.0);
        for row in y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(height) {
            add_scaled(
                &mut column_sums[RADIUS..RADIUS + width],
                &plane[row * width..][..width],
                window[row + RADIUS - y],
            );
        }
        for (shift, tap) in window.into_iter().enumerate() {
            add_scaled(out, &column_sums[shift..shift + width], tap);
        }
    }
    blurred
}

fn add_scaled(out: &mut [f64], row: &[f64], factor: f64) {
    for (out, value) in out.iter_mut().zip(row) {
        *out += factor * value;
    }
}
