//! The norm of one channel in double precision: statistics of the image itself, biased variance, affine, `ReLU`.

use super::conv3x3::activate;
use crate::kernels::norm_merge::EPSILON;

/// Mean and 1 / standard deviation.
#[derive(Clone, Copy, Debug)]
pub struct Statistics {
    /// Mean of the channel.
    pub mean: f64,
    /// 1 / sqrt(variance + EPSILON).
    pub inverse_deviation: f64,
}

/// gamma and beta of a channel.
#[derive(Clone, Copy, Debug)]
pub struct Affine {
    /// The scale.
    pub gamma: f64,
    /// The shift.
    pub beta: f64,
}

impl Statistics {
    /// Those of a channel's values.
    pub fn of(values: &[f64]) -> Self {
        let [mean, squares] = moments(values);
        Self::new(mean, squares / values.len() as f64)
    }

    pub(super) fn new(mean: f64, variance: f64) -> Self {
        Self { mean, inverse_deviation: 1.0 / (variance + EPSILON).sqrt() }
    }

    /// (z - mean) / deviation.
    pub fn normalised(&self, z: f64) -> f64 {
        (z - self.mean) * self.inverse_deviation
    }
}

impl Affine {
    /// gamma n + beta: what the `ReLU` sees.
    pub fn apply(&self, normalised: f64) -> f64 {
        self.gamma * normalised + self.beta
    }
}

/// The mean and the sum of squared deviations.
pub(super) fn moments(values: &[f64]) -> [f64; 2] {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    [mean, values.iter().map(|z| (z - mean).powi(2)).sum()]
}

/// relu(gamma n + beta) of every value of a channel.
pub fn forward(statistics: Statistics, affine: Affine, z: &[f64]) -> Vec<f64> {
    z.iter().map(|&z| activate(1, affine.apply(statistics.normalised(z)))).collect()
}

/// The sums over the values of `d_y` and of `d_y` n: the gradients of beta and of gamma.
pub fn backward_sums(
    statistics: Statistics,
    affine: Affine,
    z: &[f64],
    d_output: &[f64],
) -> [f64; 2] {
    let mut sums = [0.0; 2];
    for (&z, &d) in z.iter().zip(d_output) {
        let normalised = statistics.normalised(z);
        if affine.apply(normalised) > 0.0 {
            sums[0] += d;
            sums[1] += d * normalised;
        }
    }
    sums
}

/// The gradient of every value, given the sums of [`backward_sums`] divided by the number of values.
pub fn backward(
    statistics: Statistics,
    affine: Affine,
    means: [f64; 2],
    z: &[f64],
    d_output: &[f64],
) -> Vec<f64> {
    let one = |(&z, &d): (&f64, &f64)| {
        let normalised = statistics.normalised(z);
        let d_y = if affine.apply(normalised) > 0.0 { d } else { 0.0 };
        let centred = d_y - means[0] - normalised * means[1];
        affine.gamma * statistics.inverse_deviation * centred
    };
    z.iter().zip(d_output).map(one).collect()
}

impl From<crate::kernels::ChannelStatistics> for Statistics {
    fn from(statistics: crate::kernels::ChannelStatistics) -> Self {
        Self {
            mean: statistics.mean.into(),
            inverse_deviation: statistics.inverse_deviation.into(),
        }
    }
}

/// gamma and beta of channel `channel` of a layer at `offset`.
pub(super) fn affine(values: &[f32], offset: u32, channels: usize, channel: usize) -> Affine {
    let at = offset as usize + channel;
    Affine { gamma: values[at].into(), beta: values[at + channels].into() }
}
