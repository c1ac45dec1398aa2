//! Exposures of views: gain and bias of each channel.

pub mod table;

use std::fmt;

use nightsplat_core::{Error, Result};

use crate::image::Image;

/// The exposure of a view: encoded values times gain plus bias, per channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Affine {
    /// Of red, green and blue, above 0.
    pub gain: [f64; 3],
    /// Of red, green and blue.
    pub bias: [f64; 3],
}

impl Affine {
    /// The identity.
    pub const IDENTITY: Self = Self { gain: [1.0; 3], bias: [0.0; 3] };

    /// The affine that maps `from` to `to`, by least squares for each channel. A channel that is constant in `from`
    /// gets a bias only.
    pub fn least_squares(from: &Image, to: &Image) -> Result<Self> {
        let pixels = from.pixel_count();
        let is_pair = (from.width, from.height) == (to.width, to.height);
        if !is_pair || pixels == 0 {
            let problem = "the images must have the same size, and pixels";
            return Err(Error::Usage(problem.to_owned()));
        }
        let mut affine = Self::IDENTITY;
        for channel in 0..3 {
            let plane = |image: &Image| {
                let values = &image.data[channel * pixels..][..pixels];
                values.iter().map(|&value| f64::from(value)).collect::<Vec<_>>()
            };
            let [from, to] = [plane(from), plane(to)];
            let mean = |values: &[f64]| values.iter().sum::<f64>() / pixels as f64;
            let (mean_from, mean_to) = (mean(&from), mean(&to));
            let about =
                |(x, y): (&f64, &f64)| [(x - mean_from).powi(2), (x - mean_from) * (y - mean_to)];
            let [variance, covariance] = from
                .iter()
                .zip(&to)
                .map(about)
                .fold([0.0; 2], |sums, terms| [sums[0] + terms[0], sums[1] + terms[1]]);
            if variance > 0.0 {
                affine.gain[channel] = covariance / variance;
            }
            affine.bias[channel] = mean_to - affine.gain[channel] * mean_from;
        }
        Ok(affine)
    }

    /// Applies the affine to an image.
    #[must_use]
    pub fn applied(&self, image: &Image) -> Image {
        let pixels = image.pixel_count();
        let value = |(i, &value): (usize, &f32)| {
            let channel = (i / pixels.max(1)).min(2);
            (self.gain[channel] * f64::from(value) + self.bias[channel]) as f32
        };
        Image { data: image.data.iter().enumerate().map(value).collect(), ..*image }
    }

    /// The exposures relative to their mean: in the result, the geometric mean of the gains is 1, and the mean of the
    /// biases 0.
    pub fn about_their_mean(exposures: &[Self]) -> Vec<Self> {
        let mean = |of: &dyn Fn(&Self) -> f64| {
            exposures.iter().map(of).sum::<f64>() / exposures.len().max(1) as f64
        };
        let gain = [0, 1, 2].map(|c| mean(&|exposure| exposure.gain[c].ln()).exp());
        let bias = [0, 1, 2].map(|c| {
            gain[c] * mean(&|exposure| exposure.bias[c]) / mean(&|exposure| exposure.gain[c])
        });
        let about = |exposure: &Self| {
            let relative = [0, 1, 2].map(|c| exposure.gain[c] / gain[c]);
            Self {
                gain: relative,
                bias: [0, 1, 2].map(|c| exposure.bias[c] - relative[c] * bias[c]),
            }
        };
        exposures.iter().map(about).collect()
    }

    /// The inverse.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let of = |c: usize| (1.0 / self.gain[c], -self.bias[c] / self.gain[c]);
        Self { gain: [0, 1, 2].map(|c| of(c).0), bias: [0, 1, 2].map(|c| of(c).1) }
    }
}

impl fmt::Display for Affine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { gain, bias } = self;
        write!(f, "gain {gain:?} and bias {bias:?}")
    }
}
