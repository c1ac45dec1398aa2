//! The norm of one channel, in any number type: statistics of the image itself, biased variance, affine, `ReLU`.

use nightsplat_photographs::tone::Real;

use super::rounding::{Gated, Rounded};
use crate::kernels::ChannelStatistics;
use crate::kernels::norm_merge::EPSILON;

/// Mean and 1 / standard deviation.
#[derive(Clone, Copy, Debug)]
pub struct NormStatistics<T = f64> {
    /// Mean of the channel.
    pub mean: T,
    /// 1 / sqrt(variance + EPSILON).
    pub inverse_deviation: T,
}

/// gamma and beta of a channel.
#[derive(Clone, Copy, Debug)]
pub struct NormAffine<T = f64> {
    /// The scale.
    pub gamma: T,
    /// The shift.
    pub beta: T,
}

impl NormStatistics {
    /// Those of a channel's values.
    pub fn from_values(values: &[f64]) -> Self {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        Self::new(mean, values.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / n)
    }
}

impl<T: Real> NormStatistics<T> {
    pub(super) fn new(mean: T, variance: T) -> Self {
        Self {
            mean,
            inverse_deviation: T::from_f64(1.0) / (variance + T::from_f64(EPSILON)).sqrt(),
        }
    }

    /// (z - mean) / deviation.
    pub fn normalised(&self, z: T) -> T {
        (z - self.mean) * self.inverse_deviation
    }
}

impl<T: Real> NormAffine<T> {
    /// gamma n + beta: the input of the `ReLU`.
    pub fn apply(&self, normalised: T) -> T {
        self.gamma * normalised + self.beta
    }
}

/// relu(gamma n + beta) of every value of a channel; a NaN stays one.
pub fn forward<T: Real>(statistics: NormStatistics<T>, affine: NormAffine<T>, z: &[T]) -> Vec<T> {
    let relu = |y: T| if y.partial_cmp(&y).is_none() { y } else { y.at_least(T::from_f64(0.0)) };
    z.iter().map(|&z| relu(affine.apply(statistics.normalised(z)))).collect()
}

/// `d_y` and `d_y` n of every value.
pub fn backward_terms<T: Gated>(
    statistics: NormStatistics<T>,
    affine: NormAffine<T>,
    z: &[T],
    d_output: &[T],
) -> impl Iterator<Item = [T; 2]> {
    z.iter().zip(d_output).map(move |(&z, &d)| {
        let normalised = statistics.normalised(z);
        let d_y = d.where_positive(affine.apply(normalised));
        [d_y, d_y * normalised]
    })
}

/// The sums over the values of `d_y` and of `d_y` n: the gradients of beta and of gamma.
pub fn backward_sums(
    statistics: NormStatistics,
    affine: NormAffine,
    z: &[f64],
    d_output: &[f64],
) -> [f64; 2] {
    let terms = backward_terms(statistics, affine, z, d_output);
    terms.fold([0.0; 2], |sums, terms| [sums[0] + terms[0], sums[1] + terms[1]])
}

/// The gradient of every value, given the sums of [`backward_sums`] divided by the number of values.
pub fn backward<T: Gated>(
    statistics: NormStatistics<T>,
    affine: NormAffine<T>,
    means: [T; 2],
    z: &[T],
    d_output: &[T],
) -> Vec<T> {
    let one = |(&z, &d): (&T, &T)| {
        let normalised = statistics.normalised(z);
        let d_y = d.where_positive(affine.apply(normalised));
        let centred = d_y - means[0] - normalised * means[1];
        affine.gamma * statistics.inverse_deviation * centred
    };
    z.iter().zip(d_output).map(one).collect()
}

impl From<ChannelStatistics> for NormStatistics<Rounded> {
    fn from(statistics: ChannelStatistics) -> Self {
        Self {
            mean: Rounded::exact(statistics.mean),
            inverse_deviation: Rounded::exact(statistics.inverse_deviation),
        }
    }
}

/// gamma and beta of channel `channel` of a layer at `offset`.
pub(super) fn affine(
    values: &[f32],
    offset: u32,
    channels: u32,
    channel: usize,
) -> NormAffine<Rounded> {
    let at = offset as usize + channel;
    let [gamma, beta] = [at, at + channels as usize].map(|at| Rounded::exact(values[at]));
    NormAffine { gamma, beta }
}

/// Channel `channel` of an image.
pub(super) fn plane(image: &[f32], pixels: u32, channel: usize) -> Vec<Rounded> {
    let pixels = pixels as usize;
    Rounded::all(&image[channel * pixels..][..pixels])
}
