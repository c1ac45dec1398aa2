//! Measurements of one photograph, as stored: brightness, code values, noise, blur.

use nightsplat_photographs::image::{Image, MIDDLE_GREY, Mask, linear_from_srgb};
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{
    MeasuredPhotograph, NEAR_WHITE, ToneSettings, bounded, luminance, measurable,
};

use super::geometry::deviation;
use super::noise::{self, ChannelNoise, NoisePatch};
use super::sharpness;
use super::target_noise::{TargetNoise, target_noise};

/// Blur is measured in the middle of the photograph, in at most this many pixels each way.
const BLUR_SIDE: u32 = 640;
/// Columns and rows of the regions whose light is compared.
const REGIONS: [usize; 2] = [8, 6];

/// The factor of light to a metered exposure, for a photograph of this mean light.
pub(super) fn darkening(light: f64) -> f64 {
    f64::from(MIDDLE_GREY) / light.max(f64::MIN_POSITIVE)
}

/// Measurements of one photograph; fractions are over the values of all channels.
#[derive(Clone, Debug)]
pub(super) struct PhotographStatistics {
    pub(super) size: [u32; 2],
    pub(super) encoded: MeasuredPhotograph,
    pub(super) noise_in_target: Option<TargetNoise>,
    /// The mean luminance in linear light.
    pub(super) light: f64,
    pub(super) near_white_fraction: f64,
    pub(super) zero_fraction: f64,
    /// The number of different values, of 2^`bits`.
    pub(super) code_values: usize,
    pub(super) noise: Option<ChannelNoise>,
    pub(super) patches: Vec<NoisePatch>,
    pub(super) blur: Option<f64>,
    /// The standard deviation of log2 linear luminance over large regions.
    pub(super) unevenness: f64,
    /// A checksum of the pixels.
    pub(super) checksum: u64,
}

impl PhotographStatistics {
    /// Measures the unmasked pixels of an image; noise and blur are those of the whole.
    pub(super) fn new(image: &Image, mask: Option<&Mask>) -> Self {
        let counted = mask.map(|mask| mask.counted(image));
        let counted = counted.as_deref().unwrap_or(&image.data);
        let encoded = MeasuredPhotograph::measure(counted);
        let scene =
            SceneTone::from_photographs(&ToneSettings::default(), std::slice::from_ref(&encoded));
        let curve = scene.and_then(|scene| scene.inverse_of_scene().ok());
        let values = counted.len().max(1) as f64;
        let fraction = |is: fn(f32) -> bool| {
            counted.iter().filter(|&&value| is(value)).count() as f64 / values
        };
        let linear = Linear::new(image);
        let mut patches = vec![];
        for plane in linear.planes.chunks(image.pixel_count().max(1)) {
            patches.extend(noise::patches(plane, image.width as usize, linear.step));
        }
        let luminance = luminances(&linear.planes);
        Self {
            size: [image.width, image.height],
            noise_in_target: curve.and_then(|curve| target_noise(image, &curve)),
            encoded,
            light: mean(&luminance),
            // Written so that a NaN is neither.
            near_white_fraction: fraction(|value| f64::from(value) >= NEAR_WHITE),
            zero_fraction: fraction(|value| value == 0.0),
            code_values: code_values(counted),
            noise: noise::fit(patches.clone()),
            patches,
            blur: blur(image),
            unevenness: unevenness(&luminance, image.width as usize),
            checksum: nightsplat_core::hash::checksum(bytemuck::cast_slice(&image.data)),
        }
    }
}

/// The largest value that is measured.
const LARGEST: f32 = 65504.0;

/// The planes in linear light.
struct Linear {
    planes: Vec<f32>,
    /// The step between two codes, in encoded values; 0 for a float image.
    step: f64,
}

impl Linear {
    fn new(image: &Image) -> Self {
        let levels = [255.0_f32, 65_535.0].into_iter().find(|&levels| {
            let is_whole = |value: &f32| {
                let code = value * levels;
                (code - rounded(code)).abs() <= 2e-3 && (0.0..=levels).contains(&code)
            };
            // Without an early exit, the compiler tests the values of a chunk in vectors.
            let are_whole = |values: &[f32]| values.iter().fold(true, |all, x| all & is_whole(x));
            image.data.chunks(1024).all(are_whole)
        });
        let Some(levels) = levels else {
            // Signed: noise that is cut at black is underestimated.
            let planes = image.data.iter().map(|&value| linear_from_srgb(bounded(value, LARGEST)));
            return Self { planes: planes.collect(), step: 0.0 };
        };
        let table: Vec<f32> =
            (0..=levels as u32).map(|code| linear_from_srgb(code as f32 / levels)).collect();
        let value = |&value: &f32| table[rounded(value * levels) as usize];
        Self { planes: image.data.iter().map(value).collect(), step: 1.0 / f64::from(levels) }
    }
}

/// The nearest whole number, of two the even one, below 2^22; `round` is a function call on many processors.
fn rounded(value: f32) -> f32 {
    /// In its octave, floats are whole numbers: the sum is rounded to one.
    const WHOLE: f32 = 1.5 * (1 << 23) as f32;
    (value + WHOLE) - WHOLE
}

/// The number of different values, as 16-bit codes.
fn code_values(data: &[f32]) -> usize {
    let mut used = vec![false; 1 << 16];
    for &value in data {
        used[rounded(measurable(value).min(1.0) * 65_535.0) as usize] = true;
    }
    used.into_iter().filter(|&used| used).count()
}

fn luminances(planes: &[f32]) -> Vec<f32> {
    let (red, rest) = planes.split_at(planes.len() / 3);
    let (green, blue) = rest.split_at(red.len());
    red.iter().zip(green).zip(blue).map(|((&r, &g), &b)| luminance([r, g, b])).collect()
}

fn mean(values: &[f32]) -> f64 {
    values.iter().map(|&value| f64::from(value)).sum::<f64>() / values.len().max(1) as f64
}

/// The blur of the encoded luminance in the middle of the photograph.
fn blur(image: &Image) -> Option<f64> {
    let (width, height) = (image.width.min(BLUR_SIDE), image.height.min(BLUR_SIDE));
    let (left, top) = ((image.width - width) / 2, (image.height - height) / 2);
    let width = width as usize;
    let mut middle = Vec::with_capacity(width * height as usize);
    for y in top..top + height {
        let first = y as usize * image.width as usize + left as usize;
        let row = |plane: usize| &image.data[plane * image.pixel_count() + first..][..width];
        let colors = row(0).iter().zip(row(1)).zip(row(2));
        middle.extend(colors.map(|((&r, &g), &b)| luminance([r, g, b].map(measurable))));
    }
    sharpness::blur(&middle, width)
}

/// The standard deviation of log2 of the mean over large regions; 0 if all is black.
fn unevenness(luminance: &[f32], width: usize) -> f64 {
    let height = luminance.len() / width.max(1);
    let [columns, rows] = REGIONS;
    let mut regions = vec![(0.0, 0.0); columns * rows];
    let column_of: Vec<usize> = (0..width).map(|x| x * columns / width).collect();
    for (y, row) in luminance.chunks(width.max(1)).enumerate() {
        let regions = &mut regions[y * rows / height * columns..][..columns];
        for (value, &column) in row.iter().zip(&column_of) {
            let (sum, count) = &mut regions[column];
            *sum += f64::from(*value);
            *count += 1.0;
        }
    }
    let means: Vec<f64> = regions.iter().map(|&(sum, count)| sum / f64::max(count, 1.0)).collect();
    let whole = means.iter().sum::<f64>() / means.len() as f64;
    // Regions are clamped at a thousandth of the mean, so that a black corner does not dominate.
    let logs: Vec<f64> = means.iter().map(|mean| mean.max(1e-3 * whole).log2()).collect();
    deviation(logs.iter().copied()).filter(|_| whole > 0.0).unwrap_or(0.0)
}
