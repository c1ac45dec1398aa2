//! Noise in a target: sensor noise, quantisation and JPEG artefacts together, under the tone curve.
//!
//! Quantisation and JPEG leave dark photographs flat or blotchy: second differences do not see the blotches, and the
//! tone curve amplifies them. So a part of the photograph is tone-mapped, and each patch is compared with a plane
//! fitted to it, in luminance Y and in the colour differences R - Y and B - Y. A patch is wider than the 16 pixels of a
//! JPEG chroma block. Among the patches of medium brightness, half show texture, which is mostly grey: luma is the
//! first quartile of the patches, chroma their median.

use nightsplat_photographs::image::Image;
use nightsplat_photographs::tone::{InverseTone, bounded, luminance};
use serde::Serialize;

use super::geometry::median;

/// Side of a patch, pixels.
const SIDE: u32 = 32;
/// The stride of sampled pixels in a patch.
const STRIDE: u32 = 2;
/// The most patches of a photograph, evenly spread.
const MOST: u32 = 400;
/// The quantiles of the patches' variances that give the noise of luma and of chroma.
const QUANTILES: [f64; 2] = [0.25, 0.5];

/// The noise in the target of one photograph, as standard deviations of encoded values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TargetNoise {
    /// Of the luminance.
    pub luma: f64,
    /// Root mean square over R - Y and B - Y.
    pub chroma: f64,
}

impl TargetNoise {
    /// The median of each; `None` without a value.
    pub(super) fn median(of: impl Iterator<Item = Self>) -> Option<Self> {
        let (luma, chroma) = of.map(|one| (one.luma, one.chroma)).unzip();
        Some(Self { luma: median(luma)?, chroma: median(chroma)? })
    }
}

/// The noise in the target of a photograph under this curve; `None` if it is smaller than a patch.
pub(super) fn target_noise(image: &Image, curve: &InverseTone) -> Option<TargetNoise> {
    let (columns, rows) = (image.width / SIDE, image.height / SIDE);
    let step = (columns * rows).div_ceil(MOST).max(1) as usize;
    let indices = (0..columns * rows).step_by(step);
    let mut patches: Vec<TargetPatch> = indices
        .map(|index| {
            TargetPatch::new(image, [index % columns * SIDE, index / columns * SIDE], curve)
        })
        .collect();
    patches.sort_unstable_by(|a, b| a.brightness.total_cmp(&b.brightness));
    let quarter = patches.len() / 4;
    let middle = &patches[quarter..patches.len() - quarter];
    let deviation = |of: fn(&TargetPatch) -> f64, part: f64| {
        let mut variances: Vec<f64> = middle.iter().map(of).collect();
        variances.sort_unstable_by(f64::total_cmp);
        variances.get((variances.len() as f64 * part) as usize).map(|variance| variance.sqrt())
    };
    let [luma, chroma] = QUANTILES;
    Some(TargetNoise {
        luma: deviation(|patch| patch.luma, luma)?,
        chroma: deviation(|patch| patch.chroma, chroma)?,
    })
}

/// A square of a target.
struct TargetPatch {
    brightness: f64,
    /// Variances about the fitted planes.
    luma: f64,
    chroma: f64,
}

impl TargetPatch {
    fn new(image: &Image, [left, top]: [u32; 2], curve: &InverseTone) -> Self {
        let side = SIDE / STRIDE;
        let mut values = [const { Vec::new() }; 3];
        for y in 0..side {
            for x in 0..side {
                let stored = image.pixel(left + STRIDE * x, top + STRIDE * y);
                let target = curve.target(stored.map(|x| bounded(x, 65504.0).into()));
                let rgb = target.map(|value| value.min(1.0) as f32);
                let luma = f64::from(luminance(rgb));
                let [red, _, blue] = rgb.map(f64::from);
                for (values, value) in values.iter_mut().zip([luma, red - luma, blue - luma]) {
                    values.push(value);
                }
            }
        }
        let [luma, red, blue] =
            values.each_ref().map(|values| variance_about_plane(values, side as usize));
        let brightness = values[0].iter().sum::<f64>() / values[0].len() as f64;
        Self { brightness, luma, chroma: 0.5 * (red + blue) }
    }
}

/// The variance of a square of values about the plane fitted to it.
fn variance_about_plane(values: &[f64], side: usize) -> f64 {
    let middle = (side as f64 - 1.0) / 2.0;
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let (mut squares, mut across, mut along, mut spread) = (0.0, 0.0, 0.0, 0.0);
    for (index, value) in values.iter().enumerate() {
        let (x, y) = ((index % side) as f64 - middle, (index / side) as f64 - middle);
        squares += (value - mean).powi(2);
        across += x * value;
        along += y * value;
        spread += x * x;
    }
    // The plane has three degrees of freedom.
    let rest = squares - (across * across + along * along) / spread;
    rest.max(0.0) / (values.len() - 3) as f64
}

#[cfg(test)]
mod tests {
    use super::super::noise;
    use super::*;
    use nightsplat_core::random::Stream;
    use nightsplat_photographs::image::ImageFile as _;
    use nightsplat_photographs::image::linear_from_srgb;
    use nightsplat_photographs::scene_tone::SceneTone;
    use nightsplat_photographs::tone::{MeasuredPhotograph, ToneSettings, soft};

    const SIZE: [u32; 2] = [512, 384];

    fn found(image: &Image) -> TargetNoise {
        target_noise(image, &scene(image).inverse_of_scene().unwrap()).unwrap()
    }

    fn scene(image: &Image) -> SceneTone {
        let measured = MeasuredPhotograph::measure(&image.data);
        SceneTone::from_photographs(&ToneSettings::default(), &[measured]).unwrap()
    }

    /// A dark gradient in every patch, with noise of this deviation in each channel, and a textured half.
    fn dark(deviation: [f64; 3]) -> Image {
        let stream = Stream::new(3, 0);
        Image::from_fn(SIZE[0], SIZE[1], |x, y| {
            let texture =
                if x < SIZE[0] / 2 { 0.0 } else { 0.02 * f64::from(x % 7 + y % 5) / 10.0 };
            let signal = 0.04 + 0.02 * f64::from(y) / f64::from(SIZE[1]) + texture;
            let draw = 3 * u64::from(y * SIZE[0] + x);
            [0, 1, 2].map(|channel| {
                (signal + deviation[channel] * stream.normal(draw + channel as u64)) as f32
            })
        })
    }

    #[test]
    fn noise_of_each_channel_is_found_as_the_curve_amplifies_it() {
        let image = dark([0.002; 3]);
        let gain = scene(&image).exposure.unwrap().gain;
        // In the middle of the flat half; the curve is nearly linear over the noise.
        let slope = (soft(0.051, gain) - soft(0.049, gain)) / 0.002;
        let kept = (soft(0.05, gain) - soft(0.0, gain)) / 0.05;
        let kept_slope = 2.0 / 3.0 * slope + kept / 3.0;
        let weights = [0.299, 0.587, 0.114];
        let squares = |of: [f64; 3]| of.iter().map(|weight| weight * weight).sum::<f64>().sqrt();
        let chroma = |channel: usize| {
            let mut of = weights.map(|weight| -weight);
            of[channel] += 1.0;
            squares(of)
        };
        let chroma = (0.5 * (chroma(0).powi(2) + chroma(2).powi(2))).sqrt();
        let found = found(&image);
        assert!((found.luma / (0.002 * slope * squares(weights)) - 1.0).abs() < 0.15, "{found:?}");
        assert!((found.chroma / (0.002 * kept_slope * chroma) - 1.0).abs() < 0.15, "{found:?}");
    }

    #[test]
    fn a_clean_photograph_has_no_noise_and_a_small_one_no_estimate() {
        let found = found(&dark([0.0; 3]));
        assert!(found.luma < 3e-3 && found.chroma < 3e-3, "{found:?}");
        let small = Image::filled(31, 200, [0.1; 3]);
        assert_eq!(target_noise(&small, &scene(&small).inverse_of_scene().unwrap()), None);
    }

    #[test]
    fn jpeg_artefacts_are_found_where_sensor_noise_is_not() {
        let stored = dark([0.004, 0.004, 0.006]).to_jpeg(90).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jpg");
        std::fs::write(&path, stored).unwrap();
        let image = Image::load(&path).unwrap();
        let linear: Vec<f32> = image.data.iter().map(|&value| linear_from_srgb(value)).collect();
        let patches = noise::patches(&linear[..image.pixel_count()], SIZE[0] as usize, 1.0 / 255.0);
        let sensor = noise::fit(patches).map_or(0.0, |noise| noise.deviation(0.004));
        let found = found(&image);
        assert!(found.chroma > 0.005 && found.luma > 0.005, "{found:?}, sensor {sensor}");
        assert!(sensor < 5e-4, "{found:?}, sensor {sensor}");
    }

    #[test]
    fn quantisation_counts_as_noise() {
        let plain = dark([0.002; 3]);
        let data = plain.data.iter().map(|x| (x * 255.0).round() / 255.0).collect();
        let [plain, coded] =
            [plain.clone(), Image { data, ..plain }].map(|image| found(&image).luma);
        // Quantisation adds 1/12 of a squared step to the variance of half a step in each channel.
        assert!((coded / plain - 1.155).abs() < 0.08, "{coded} {plain}");
    }
}
