//! What a curve knows of a photograph: two percentiles and two means.

/// Added to both percentiles, so that a black photograph divides by something.
const EPSILON: f32 = 1e-6;

/// Values beyond this are taken for it in the statistics: the largest half float.
const LARGEST: f32 = 65504.0;

/// The statistics of one photograph, over all its pixels, on sRGB-encoded values.
///
/// They are finite for every input: NaN and negative values count as 0, and values above 65504 as 65504.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Statistics {
    /// The 10th percentile of the luminance, plus 1e-6.
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

/// BT.601 luminance of an RGB value, in the order of operations of the kernel.
pub fn luminance([r, g, b]: [f32; 3]) -> f32 {
    0.299 * r + 0.587 * g + 0.114 * b
}

/// The `tenths` / 10 quantile of non-negative values, linear between the two neighbours of
/// rank q (n - 1) as `torch.quantile` has it; reorders the values. 0 of no values.
///
/// The rank is split in integers: a rank in f32 is wrong beyond 2^24 values.
pub fn percentile(values: &mut [f32], tenths: usize) -> f32 {
    let Some(last) = values.len().checked_sub(1) else { return 0.0 };
    let rank = tenths * last / 10;
    let weight = (tenths * last % 10) as f32 / 10.0;
    let (_, &mut lower, above) = values.select_nth_unstable_by(rank, f32::total_cmp);
    let upper = above.iter().copied().min_by(f32::total_cmp).unwrap_or(lower);
    lower + weight * (upper - lower)
}

/// A value the statistics can take: finite, not negative.
fn measurable(x: f32) -> f32 {
    // Positive phrasing: a NaN fails it too.
    if x > 0.0 { x.min(LARGEST) } else { 0.0 }
}
