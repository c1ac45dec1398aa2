//! Histograms of the luminance of one or several photographs.

use super::statistics::{luminance, measurable};

/// Bits of a luminance that its bin number drops: 128 bins per octave remain.
const BIN_SHIFT: u32 = 16;

/// The number of the first bin: 2^-15, a hundredth of an 8-bit code value.
const FIRST_BIN: u32 = 14 << 10;

/// The bins extend to 2^17.
const BINS: usize = 4096;

/// The number of pixels per luminance, in bins of a 128th of an octave; everything below 2^-15 counts as 0.
///
/// Derived values have an error of at most 0.4 % (if all pixels are equal), and far less for a photograph.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LuminanceHistogram {
    /// The non-empty bins, ascending, with their numbers of pixels.
    counts: Vec<(u32, u64)>,
    black: u64,
    /// Over all pixels, of the difference between the largest and smallest channel, and of the largest.
    chroma: f64,
    value: f64,
    /// Whether any of the photographs has more than one channel that is not empty.
    has_colour: bool,
}

/// A channel whose sum is less than this fraction of the largest is empty.
pub const EMPTY_CHANNEL: f64 = 0.03;

/// For each channel itself, or the brightest one if its sum makes it empty: an image intensifier fills green alone.
fn filled_channels(sums: [f64; 3]) -> [usize; 3] {
    let brightest = (0..3).fold(0, |most, at| if sums[at] > sums[most] { at } else { most });
    let is_empty = |at: usize| sums[at] < EMPTY_CHANNEL * sums[brightest];
    [0, 1, 2].map(|at| if is_empty(at) { brightest } else { at })
}

impl LuminanceHistogram {
    /// The histogram of a planar (3, H, W) photograph, sRGB-encoded; NaN and negative values count as 0. An
    /// empty channel counts as the brightest.
    pub fn new(planes: &[f32]) -> Self {
        Self::counted(planes).0
    }

    /// The histogram, and the luminance of each pixel and the sum of each channel as stored.
    pub(super) fn counted(planes: &[f32]) -> (Self, Vec<f32>, [f64; 3]) {
        let (red, rest) = planes.split_at(planes.len() / 3);
        let planes = [red, &rest[..red.len()], &rest[red.len()..]];
        let mut luminances = Vec::with_capacity(red.len());
        let (histogram, sums) = Self::filled(planes, |luminance| luminances.push(luminance));
        let filled = filled_channels(sums);
        if filled == [0, 1, 2] {
            return (histogram, luminances, sums);
        }
        let has_colour = filled.iter().any(|channel| *channel != filled[0]);
        let (histogram, _) = Self::filled(filled.map(|channel| planes[channel]), drop);
        (Self { has_colour, ..histogram }, luminances, sums)
    }

    /// The histogram of planes none of which is empty, and their sums.
    fn filled([red, green, blue]: [&[f32]; 3], mut see: impl FnMut(f32)) -> (Self, [f64; 3]) {
        let mut counts = vec![0_u32; BINS];
        let (mut chroma, mut value, mut sums) = (0.0, 0.0, [0.0; 3]);
        for ((&r, &g), &b) in red.iter().zip(green).zip(blue) {
            let rgb = [measurable(r), measurable(g), measurable(b)];
            let most = rgb[0].max(rgb[1]).max(rgb[2]);
            chroma += f64::from(most - rgb[0].min(rgb[1]).min(rgb[2]));
            value += f64::from(most);
            for (sum, x) in sums.iter_mut().zip(rgb) {
                *sum += f64::from(x);
            }
            let y = luminance(rgb);
            see(y);
            let number = y.to_bits() >> BIN_SHIFT;
            let bin = number.checked_sub(FIRST_BIN);
            if let Some(count) = bin.and_then(|bin| counts.get_mut(bin as usize)) {
                *count += 1;
            }
        }
        let bins = (0..).zip(counts).filter(|(_, count)| *count > 0);
        let counts: Vec<(u32, u64)> = bins.map(|(bin, count)| (bin, count.into())).collect();
        let lit: u64 = counts.iter().map(|(_, count)| count).sum();
        (Self { black: red.len() as u64 - lit, counts, chroma, value, has_colour: true }, sums)
    }

    /// Whether only one channel has light, as that of an image intensifier.
    pub(super) fn is_one_channel(&self) -> bool {
        !self.has_colour && self.value > 0.0
    }

    /// Mean difference between the largest and smallest channel over the mean of the largest: 0 for greys, 1 for pure
    /// colours.
    pub(crate) fn saturation(&self) -> f64 {
        self.chroma / self.value.max(f64::MIN_POSITIVE)
    }

    /// The fraction of the pixels whose luminance is lower.
    pub(super) fn fraction_below(&self, luminance: f64) -> f64 {
        self.mean_of(|level| f64::from(u8::from(level < luminance)))
    }

    /// With a fraction of the pixels below a luminance left out.
    pub(super) fn without_below(&self, luminance: f64, left_out: f64) -> Self {
        let kept = |count: u64| ((1.0 - left_out) * count as f64).round() as u64;
        let mut rest = self.clone();
        rest.black = kept(rest.black);
        for (bin, count) in &mut rest.counts {
            *count = if centre(*bin) < luminance { kept(*count) } else { *count };
        }
        rest
    }

    /// Adds the pixels of another photograph.
    pub fn add(&mut self, other: &Self) {
        self.black += other.black;
        self.chroma += other.chroma;
        self.value += other.value;
        self.has_colour |= other.has_colour;
        self.counts.extend(&other.counts);
        // Two ascending runs, which a stable sort merges.
        self.counts.sort_by_key(|&(bin, _)| bin);
        self.counts.dedup_by(|later, first| {
            let is_same = later.0 == first.0;
            first.1 += if is_same { later.1 } else { 0 };
            is_same
        });
    }

    /// The number of pixels.
    pub fn pixel_count(&self) -> u64 {
        self.black + self.counts.iter().map(|(_, count)| count).sum::<u64>()
    }

    /// The smallest luminance that `fraction` of the pixels do not exceed; 0 without pixels.
    pub fn quantile(&self, fraction: f64) -> f64 {
        let rank = fraction * self.pixel_count().saturating_sub(1) as f64;
        let mut below = 0;
        let mut levels = self.levels();
        let at_rank = levels.find(|&(_, count)| {
            below += count;
            below as f64 > rank
        });
        at_rank.map_or(0.0, |(luminance, _)| luminance)
    }

    /// The mean over the pixels of a function of their luminance; 0 without pixels.
    pub fn mean_of(&self, value: impl Fn(f64) -> f64) -> f64 {
        let sum: f64 =
            self.levels().map(|(luminance, count)| count as f64 * value(luminance)).sum();
        sum / self.pixel_count().max(1) as f64
    }

    /// The mean luminance.
    pub fn mean(&self) -> f64 {
        self.mean_of(|luminance| luminance)
    }

    /// The cubic mean of the luminance, between the mean and the highlights. Higher values are clamped to the 99.9 %
    /// quantile, against hot pixels, and to a multiple of the 90 % quantile, against lamps.
    pub fn cubic_mean(&self) -> f64 {
        /// The brightest surfaces of evenly lit scenes have 1.4 to 2.4 times the 90 % quantile.
        const LAMP: f64 = 2.5;
        let (hot, bright) = (self.quantile(0.999), self.quantile(0.9));
        let limit = if bright > 0.0 { hot.min(LAMP * bright) } else { hot };
        self.mean_of(|luminance| luminance.min(limit).powi(3)).cbrt()
    }

    /// The luminances of non-empty bins (0, or the centres of bins), ascending, with their numbers of pixels.
    fn levels(&self) -> impl Iterator<Item = (f64, u64)> + '_ {
        let bins = self.counts.iter().map(|&(bin, count)| (centre(bin), count));
        std::iter::once((0.0, self.black)).chain(bins).filter(|&(_, count)| count > 0)
    }
}

/// The luminance in the middle of a bin.
fn centre(bin: u32) -> f64 {
    let number = FIRST_BIN + bin;
    f64::from(f32::from_bits((number << BIN_SHIFT) | 1 << (BIN_SHIFT - 1)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_luminance_is_binned_within_half_a_percent() {
        for x in [3.1e-5_f32, 1e-4, 0.0039, 0.0041, 0.5, 1.0, 1.5, 30.0, 65504.0] {
            let histogram = LuminanceHistogram::new(&[x; 3]);
            assert_eq!(histogram.pixel_count(), 1);
            let found = histogram.quantile(0.5);
            assert!((found / f64::from(x) - 1.0).abs() < 0.004, "{x}: {found}");
            assert_eq!(histogram.mean(), found);
        }
        for black in [0.0, 1e-9, -1.0, f32::NAN] {
            assert_eq!(LuminanceHistogram::new(&[black; 3]).quantile(1.0), 0.0);
        }
        assert_eq!(LuminanceHistogram::default().quantile(0.5), 0.0);
        assert_eq!(LuminanceHistogram::default().mean(), 0.0);
    }

    #[test]
    fn a_quantile_excludes_hot_pixels_and_histograms_add_up() {
        let mut planes = vec![0.25_f32; 3 * 1000];
        for plane in 0..3 {
            planes[1000 * plane] = 1.0;
        }
        let one = LuminanceHistogram::new(&planes);
        assert!((one.quantile(0.999) - 0.25).abs() < 1e-3);
        assert!((one.quantile(1.0) - 1.0).abs() < 4e-3);
        let mut both = LuminanceHistogram::new(&[0.0; 3000]);
        both.add(&one);
        assert_eq!(both.pixel_count(), 2000);
        assert!((both.mean() - 0.5 * one.mean()).abs() < 1e-12);
        assert_eq!(both.quantile(0.4), 0.0);
    }
}
