//! What a curve knows of a photograph: two percentiles and two means.

use crate::kernels::ToneStatistics;
use crate::reference::luminance::{luminance, measurable};

/// Added to both percentiles, so that a black photograph divides by something.
const EPSILON: f32 = 1e-6;

/// The statistics of one photograph, over all its pixels, on sRGB-encoded values.
///
/// They are finite for every input: NaN and negative values count as 0, and values above 65504 as 65504.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Statistics {
    /// The 10th percentile of the BT.601 luminance, plus 1e-6.
    pub p10: f32,
    /// The 90th percentile of the luminance, plus 1e-6.
    pub p90: f32,
    /// The mean of the luminance.
    pub mean_luminance: f32,
    /// The mean over all pixels of all three channels.
    pub mean: f32,
}

impl Statistics {
    /// The statistics of a planar (3, H, W) photograph; of no pixels at all, those of a black one.
    pub fn of(planes: &[f32]) -> Self {
        let (red, rest) = planes.split_at(planes.len() / 3);
        let (green, blue) = rest.split_at(red.len());
        let mut luminances = Vec::with_capacity(red.len());
        let (mut luminance_sum, mut sum) = (0.0, 0.0);
        for ((&r, &g), &b) in red.iter().zip(green).zip(blue) {
            let rgb = [r, g, b].map(measurable);
            let y = luminance(rgb);
            luminances.push(y);
            luminance_sum += f64::from(y);
            sum += rgb.iter().map(|&x| f64::from(x)).sum::<f64>();
        }
        let pixels = luminances.len().max(1) as f64;
        Self {
            p10: percentile(&mut luminances, 1) + EPSILON,
            p90: percentile(&mut luminances, 9) + EPSILON,
            mean_luminance: (luminance_sum / pixels) as f32,
            mean: (sum / (3.0 * pixels)) as f32,
        }
    }

    /// r = p10 / p90, in [0, 1]: how little the shadows are crushed.
    pub fn ratio(&self) -> f64 {
        (f64::from(self.p10) / f64::from(self.p90)).clamp(0.0, 1.0)
    }
}

impl From<ToneStatistics> for Statistics {
    fn from(ToneStatistics { p10, p90, mean_luminance, mean }: ToneStatistics) -> Self {
        Self { p10, p90, mean_luminance, mean }
    }
}

/// Where a quantile lies among sorted values: `weight` of the way from one rank to the next.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rank {
    pub(crate) lower: usize,
    pub(crate) upper: usize,
    pub(crate) weight: f32,
}

impl Rank {
    /// The rank q (n - 1), q = `tenths` / 10, split in integers: in f32 it is wrong beyond 2^24 values.
    pub(crate) fn of(tenths: usize, count: usize) -> Self {
        let last = count.saturating_sub(1);
        let lower = tenths * last / 10;
        Self { lower, upper: last.min(lower + 1), weight: (tenths * last % 10) as f32 / 10.0 }
    }
}

/// The `tenths` / 10 quantile of non-negative values, linear between the two neighbours of its rank
/// as `torch.quantile` has it; reorders the values. 0 of no values.
pub fn percentile(values: &mut [f32], tenths: usize) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let rank = Rank::of(tenths, values.len());
    let (_, &mut lower, above) = values.select_nth_unstable_by(rank.lower, f32::total_cmp);
    let upper = above.iter().copied().min_by(f32::total_cmp).unwrap_or(lower);
    lower + rank.weight * (upper - lower)
}
