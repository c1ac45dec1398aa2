//! Statistics of a photograph for its curve: percentiles and means.

/// Added to both percentiles, which are divisors.
const EPSILON: f32 = 1e-6;

/// The statistics of one photograph, over all its pixels, on sRGB-encoded values.
///
/// They are finite for every input: NaN and negative values count as 0, and values above 65504 as 65504.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Statistics {
    /// The 10th percentile of the BT.601 luminance, plus 1e-6.
    pub p10: f32,
    /// The 80th percentile of the luminance, plus 1e-6.
    pub p80: f32,
    /// The 90th percentile of the luminance, plus 1e-6.
    pub p90: f32,
    /// The mean of the luminance.
    pub mean_luminance: f32,
    /// The mean over all pixels of all three channels.
    pub mean: f32,
    /// The mean over all pixels of each channel.
    pub channel_means: [f32; 3],
}

impl Statistics {
    /// The statistics of a planar (3, H, W) photograph; without pixels, those of a black one.
    pub fn new(planes: &[f32]) -> Self {
        let (red, rest) = planes.split_at(planes.len() / 3);
        let (green, blue) = rest.split_at(red.len());
        let mut luminances = Vec::with_capacity(red.len());
        let mut sums = [0.0; 3];
        for ((&r, &g), &b) in red.iter().zip(green).zip(blue) {
            let rgb = [r, g, b].map(measurable);
            luminances.push(luminance(rgb));
            for (sum, x) in sums.iter_mut().zip(rgb) {
                *sum += f64::from(x);
            }
        }
        Self::of_luminances(luminances, sums)
    }

    /// The statistics of pixels with these luminances and sums of the channels.
    pub(super) fn of_luminances(mut luminances: Vec<f32>, sums: [f64; 3]) -> Self {
        let [red, green, blue] = sums.map(|sum| sum / luminances.len().max(1) as f64);
        let [p10, p80, p90] = percentiles(&mut luminances, [1, 8, 9]).map(|value| value + EPSILON);
        Self {
            p10,
            p80,
            p90,
            mean_luminance: (0.299 * red + 0.587 * green + 0.114 * blue) as f32,
            mean: ((red + green + blue) / 3.0) as f32,
            channel_means: [red, green, blue].map(|mean| mean as f32),
        }
    }

    /// Mean of each, the statistics of a scene from those of its training views; `None` if empty.
    pub fn mean_of(views: &[Self]) -> Option<Self> {
        let mean = |of: &dyn Fn(&Self) -> f32| {
            let sum: f64 = views.iter().map(|view| f64::from(of(view))).sum();
            (sum / views.len() as f64) as f32
        };
        (!views.is_empty()).then(|| Self {
            p10: mean(&|view| view.p10),
            p80: mean(&|view| view.p80),
            p90: mean(&|view| view.p90),
            mean_luminance: mean(&|view| view.mean_luminance),
            mean: mean(&|view| view.mean),
            channel_means: [0, 1, 2].map(|channel| mean(&|view| view.channel_means[channel])),
        })
    }

    /// p10 and p90 without the added 1e-6, as the paper prints them.
    pub fn percentiles(&self) -> [f64; 2] {
        [self.p10, self.p90].map(|value| (f64::from(value) - f64::from(EPSILON)).max(0.0))
    }

    /// r of [`Statistics::percentiles`]; 1 for a black photograph.
    pub fn printed_ratio(&self) -> f64 {
        let [p10, p90] = self.percentiles();
        if p90 > 0.0 { p10 / p90 } else { 1.0 }
    }

    /// r = p10 / p90, in [0, 1]: low if shadows are crushed.
    pub fn ratio(&self) -> f64 {
        (f64::from(self.p10) / f64::from(self.p90)).clamp(0.0, 1.0)
    }
}

/// BT.601 luminance of an RGB value, without linearisation.
pub fn luminance([r, g, b]: [f32; 3]) -> f32 {
    0.299 * r + 0.587 * g + 0.114 * b
}

/// A value that the statistics accept: finite and not negative. Targets keep the sign of noise at black; statistics are
/// of light that is averaged until little of it is negative.
pub fn measurable(x: f32) -> f32 {
    // Written so that a NaN fails.
    if x > 0.0 { x.min(65504.0) } else { 0.0 }
}

/// The `tenths` / 10 quantiles of non-negative values, in ascending order, each linear between the two neighbours of
/// its rank as in `torch.quantile`; reorders the values. 0 without values.
pub fn percentiles<const N: usize>(values: &mut [f32], tenths: [usize; N]) -> [f32; N] {
    let Some(last) = values.len().checked_sub(1) else { return [0.0; N] };
    // Values of lower ranks are before this one.
    let mut from = 0;
    tenths.map(|tenths| {
        // The rank q (n - 1) is split in integers: in f32 it is inexact beyond 2^24 values.
        let (rank, weight) = (tenths * last / 10, (tenths * last % 10) as f32 / 10.0);
        let rest = &mut values[from..];
        // The bits of such floats sort like their values.
        let (_, &mut lower, above) = rest.select_nth_unstable_by_key(rank - from, |x| x.to_bits());
        let upper = above.iter().map(|x| x.to_bits()).min().map_or(lower, f32::from_bits);
        from = rank;
        lower + weight * (upper - lower)
    })
}
