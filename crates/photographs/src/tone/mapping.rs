//! From the measurements of a photograph to its curve, at a gain that follows from the exposure if it is automatic.

use std::borrow::Cow;

use nightsplat_core::camera::Camera;
use nightsplat_core::curves::{MAX_CONSTANTS, Real, ToneCurve, clamped, curve_at, padded};
use nightsplat_core::image::{linear_from_srgb, srgb_from_linear};

use super::exposure::Exposure;
use super::histogram::LuminanceHistogram;
use super::metering::{CurveEnds, soft, solved};
use super::{Statistics, Tone, ToneParameters, ToneSettings};

/// The smallest white of linear scaling: it keeps a black photograph black.
const MIN_WHITE: f64 = 1e-12;

/// Added to a mean that is a divisor.
const EPSILON: f64 = 1e-6;

/// Minimum and maximum gain of `p80` and `lum_preserve`.
const GAINS: [f64; 2] = [1.0, 6.0];

/// Minimum and maximum of a solved gain.
const STRENGTHS: [f64; 2] = [1e-3, 1e4];

/// The settings of which a curve is a function, in any number type: the constants of its formula, then theta, alpha, c
/// and g0.
pub type CurveNumbers<T> = [T; MAX_CONSTANTS + 4];
/// The position of theta among the numbers of a curve.
pub const THETA: usize = MAX_CONSTANTS;
/// That of alpha.
pub const ALPHA: usize = THETA + 1;
/// That of c.
pub const GAIN_C: usize = ALPHA + 1;
/// That of g0.
pub const BASE_GAIN: usize = GAIN_C + 1;

/// Measurements of a photograph.
#[derive(Clone, Debug, Default)]
pub struct MeasuredPhotograph {
    /// Percentiles and means.
    pub statistics: Statistics,
    /// The histogram of its luminance.
    pub luminance: LuminanceHistogram,
    /// Its camera, if known.
    pub camera: Option<Camera>,
}

/// The largest share of values below black, where encoding cuts noise, that leaves the measurements right.
const BELOW_BLACK: f64 = 0.05;

/// The most pixels of a row over which light is averaged.
const LONGEST_RUN: usize = 32;

/// The planes to measure: each value is the mean light of the shortest run of pixels that leaves few values below
/// black. Encoding is concave, so it takes off the mean of what is noisy; cutting at black adds to it.
fn without_noise(planes: &[f32]) -> Cow<'_, [f32]> {
    let is_noisy = |values: &[f32]| {
        let negative = values.iter().filter(|value| **value < 0.0).count();
        negative as f64 > BELOW_BLACK * values.len() as f64
    };
    let mut averaged = Cow::Borrowed(planes);
    let mut run = 2;
    while run <= LONGEST_RUN && is_noisy(&averaged) {
        let planes = planes.chunks(planes.len().div_ceil(3));
        averaged = planes.flat_map(|plane| plane.chunks(run)).flat_map(mean_light).collect();
        run *= 2;
    }
    averaged
}

/// The mean light of encoded values, for each of them; what is not finite counts as black.
fn mean_light(values: &[f32]) -> impl Iterator<Item = f32> {
    let finite = values.iter().filter(|value| value.is_finite());
    let sum: f64 = finite.map(|value| f64::from(linear_from_srgb(*value))).sum();
    std::iter::repeat_n(srgb_from_linear((sum / values.len() as f64) as f32), values.len())
}

impl MeasuredPhotograph {
    /// Measures the planes (3, pixels) of a photograph.
    pub fn measure(planes: &[f32]) -> Self {
        let (luminance, luminances, sums) = LuminanceHistogram::counted(&without_noise(planes));
        let statistics = Statistics::of_luminances(luminances, sums);
        Self { statistics, luminance, camera: None }
    }

    /// All of them as one: the means of the statistics, and the luminance of every pixel.
    pub fn together(photographs: &[Self]) -> Self {
        let statistics: Vec<Statistics> = photographs.iter().map(|one| one.statistics).collect();
        let statistics = Statistics::mean_of(&statistics).unwrap_or_default();
        let mut luminance = LuminanceHistogram::default();
        photographs.iter().for_each(|one| luminance.add(&one.luminance));
        Self { statistics, luminance, camera: None }
    }

    /// Adds the camera.
    #[must_use]
    pub fn seen_by(self, camera: &Camera) -> Self {
        Self { camera: Some(*camera), ..self }
    }
}

impl ToneSettings {
    /// The settings of which the curve is a function.
    #[doc(hidden)]
    pub fn numbers(&self) -> CurveNumbers<f64> {
        let [c0, c1, c2, c3, c4, c5, c6, c7] = padded(&self.constants);
        let Self { theta, alpha, gain_c, base_gain, .. } = *self;
        [c0, c1, c2, c3, c4, c5, c6, c7, theta, alpha, gain_c, base_gain]
    }

    /// The same curve with other numbers.
    #[must_use]
    #[doc(hidden)]
    pub fn with_numbers(&self, numbers: &CurveNumbers<f64>) -> Self {
        let [constants @ .., theta, alpha, gain_c, base_gain] = *numbers;
        let constants = constants[..self.constants.len()].to_vec();
        Self { theta, alpha, gain_c, base_gain, constants, ..self.clone() }
    }

    /// White, black level and gain of a channel of a photograph with these statistics, with these numbers in place of
    /// the curve's own.
    #[doc(hidden)]
    pub fn scale<T: Real>(
        &self,
        statistics: &Statistics,
        channel: usize,
        numbers: &CurveNumbers<T>,
    ) -> [T; 3] {
        let [.., theta, alpha, gain_c, base_gain] = *numbers;
        let [zero, one, epsilon] = [0.0, 1.0, EPSILON].map(T::from_f64);
        let measured = |x: f32| T::from_f64(x.into());
        let mean_luminance = measured(statistics.mean_luminance);
        let bounded_gain = |value: T| {
            (theta / value).at_least(T::from_f64(GAINS[0])).at_most(T::from_f64(GAINS[1]))
        };
        match &self.curve {
            Tone::Formula(ToneCurve::Linear) => {
                let white = measured(statistics.mean) / theta;
                [white.at_least(T::from_f64(MIN_WHITE)), zero, one]
            }
            Tone::Formula(ToneCurve::LumPreserve) => {
                [one, zero, bounded_gain(mean_luminance + epsilon)]
            }
            Tone::Formula(ToneCurve::PerChannel) => {
                [(measured(statistics.channel_means[channel]) + epsilon) / theta, zero, one]
            }
            Tone::Formula(ToneCurve::P80) => {
                [one / bounded_gain(measured(statistics.p80)), zero, one]
            }
            curve if curve.is_of_t() => {
                let is_rescaled = curve.family().is_some_and(|family| family.is_rescaled);
                let least = if is_rescaled { base_gain } else { one };
                [
                    measured(statistics.p90),
                    black_level(alpha, self.beta, statistics.ratio()),
                    least + gain_c * mean_luminance,
                ]
            }
            _ => [one, zero, one],
        }
    }

    /// delta0 = alpha (1 - r)^beta: the black level of a photograph with r = p10 / p90. For the automatic curve it is
    /// alpha.
    #[doc(hidden)]
    pub fn offset(&self, ratio: f64) -> f64 {
        if self.curve == Tone::Auto {
            self.alpha
        } else {
            black_level(self.alpha, self.beta, ratio)
        }
    }

    /// The curve of a photograph with these statistics, before an automatic gain.
    #[doc(hidden)]
    pub fn parameters(&self, statistics: &Statistics) -> ToneParameters {
        let scale = |channel| self.scale(statistics, channel, &self.numbers()).map(|x| x as f32);
        let [mut white, mut offset, gain] = scale(0);
        let mut constants = padded(&self.constants).map(|constant| constant as f32);
        if self.curve == Tone::Auto {
            (offset, constants[0]) = (self.alpha as f32, self.colour as f32);
        }
        if self.curve == ToneCurve::PerChannel {
            constants[..3].copy_from_slice(&[0, 1, 2].map(|channel| scale(channel)[0]));
            white = 1.0;
        }
        ToneParameters { white, offset, gain, weight: 1.0, constants }
    }

    /// The curve at t = x / p90, in [0, 1], for a photograph with these statistics. A table of three channels, or a
    /// profile, is evaluated for green, `lum_preserve` and `per_channel` for grey.
    #[doc(hidden)]
    pub fn value(&self, t: f64, statistics: &Statistics) -> f64 {
        let grey = Statistics { channel_means: [statistics.mean; 3], ..*statistics };
        let ToneParameters { mut white, offset, gain, constants, .. } = self.parameters(&grey);
        if self.curve == ToneCurve::PerChannel {
            white = constants[0];
        }
        // Without a scene that determines k: a function of k x.
        let is_of_t = !self.curve.is_exposed();
        let t = if is_of_t { t * f64::from(statistics.p90) / f64::from(white) } else { t };
        match &self.curve {
            Tone::Expression(expression) => clamped(expression.at(t, &padded(&self.constants))),
            Tone::Table(table) => table.value(t, 1),
            Tone::Profile(profile) => profile.value([t; 3])[1],
            Tone::Formula(_) | Tone::Auto | Tone::External(_) => {
                let scale = [offset.into(), gain.into()];
                let constants = padded(&self.constants);
                clamped(curve_at(self.curve.constant(), t, scale, &constants))
            }
        }
    }

    /// Statistics for the plain formula of a curve: no black level, gain 1, and t = 1 at its white.
    #[doc(hidden)]
    pub fn plain_statistics(&self) -> Statistics {
        let theta = self.theta as f32;
        let means = Statistics { mean: theta, channel_means: [theta; 3], ..Statistics::default() };
        Statistics { p10: 1.0, p80: theta, p90: 1.0, ..means }
    }

    /// The curve at a gain that follows from the exposure.
    #[doc(hidden)]
    pub fn exposed(
        &self,
        exposure: &Exposure,
        parameters: ToneParameters,
        luminance: &LuminanceHistogram,
        gain: f64,
    ) -> ToneParameters {
        let strength = match self.curve {
            Tone::Auto | Tone::Profile(_) => gain,
            _ => self.strength(&parameters, luminance, gain),
        };
        let weight = match self.curve {
            // A profile applies to bright photographs, too.
            Tone::Profile(_) => 1.0,
            _ if exposure.is_lit(luminance) => 0.0,
            _ => exposure.weight(),
        };
        let mut constants = parameters.constants;
        if self.curve == Tone::Auto {
            let CurveEnds { shoulder, toe, toe_weight } = exposure.ends;
            // A blend with the photograph has its black.
            let toe_weight = if weight < 1.0 { 0.0 } else { toe_weight };
            // The luminance of one channel keeps no ratios.
            constants[0] = if luminance.is_one_channel() { 0.0 } else { constants[0] };
            constants[1..4].copy_from_slice(&[shoulder, toe, toe_weight].map(|end| end as f32));
        }
        let (white, weight) = ((1.0 / strength) as f32, weight as f32);
        ToneParameters { white, gain: 1.0, weight, constants, ..parameters }
    }

    /// The factor on x that gives the curve the mean luminance of soft(x; gain).
    fn strength(&self, tone: &ToneParameters, luminance: &LuminanceHistogram, gain: f64) -> f64 {
        let target = luminance.mean_of(|y| soft(y, gain));
        let (curve, scale) = (self.curve.constant(), [f64::from(tone.offset), 1.0]);
        let constants = tone.constants.map(f64::from);
        let mean = |strength: f64| {
            luminance.mean_of(|y| clamped(curve_at(curve, strength * y, scale, &constants)))
        };
        solved(STRENGTHS, |strength| mean(strength) < target)
    }
}

/// delta0 = alpha (1 - r)^beta of a photograph with r = p10 / p90; with beta 0 it is alpha for every photograph.
fn black_level<T: Real>(alpha: T, beta: f64, ratio: f64) -> T {
    alpha * T::from_f64((1.0 - ratio).powf(beta))
}
