//! The formula of the curves: from settings and a photograph's statistics to the curve's parameters, and its value at
//! x. It is generic over the number type: f64 for the kernels' parameters, dual numbers for the derivatives of a fit,
//! f32 for the kernels' references.

use super::Statistics;
use super::families::{Constants, Family, OffsetMode, White, curve_shape};
use super::real::{Real, within};
use crate::kernels::ToneParameters;
use crate::kernels::curves::*;

/// The smallest white of linear scaling: it keeps a black photograph black.
const MIN_WHITE: f64 = 1e-12;

/// Added to a mean that is a divisor.
const EPSILON: f64 = 1e-6;

/// Minimum and maximum gain of `p80` and `lum_preserve`.
const GAINS: [f64; 2] = [1.0, 6.0];

/// The numeric settings of [`ToneSettings`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct CurveInputs<T> {
    pub(crate) theta: T,
    pub(crate) alpha: T,
    pub(crate) beta: f64,
    pub(crate) gain_c: T,
    pub(crate) base_gain: T,
    pub(crate) constants: Constants<T>,
}

/// The curve of one photograph: [`ToneParameters`] in any number type.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PhotographCurve<T> {
    /// The value that t = 1 corresponds to.
    pub(crate) white: T,
    pub(crate) offset: T,
    pub(crate) gain: T,
    /// The first three are the white of each channel, if channels differ.
    pub(crate) constants: Constants<T>,
}

/// The curve of a photograph with these statistics. `white` is the family's, or its table's.
pub(crate) fn law<T: Real>(
    family: &Family,
    white: White,
    numbers: &CurveInputs<T>,
    statistics: &Statistics,
) -> PhotographCurve<T> {
    let [zero, one, epsilon] = [0.0, 1.0, EPSILON].map(T::of);
    let measured = |x: f32| T::of(x.into());
    let mean_luminance = measured(statistics.mean_luminance);
    let bounded_gain =
        |value: T| (numbers.theta / value).at_least(T::of(GAINS[0])).at_most(T::of(GAINS[1]));
    let mut constants = numbers.constants;
    let [white, offset, gain] = match white {
        White::One => [one, zero, one],
        White::Mean => {
            let white = measured(statistics.mean) / numbers.theta;
            [white.at_least(T::of(MIN_WHITE)), zero, one]
        }
        White::MeanLuminance => [one, zero, bounded_gain(mean_luminance + epsilon)],
        White::ChannelMeans => {
            for (white, mean) in constants.iter_mut().zip(statistics.channel_means) {
                *white = (measured(mean) + epsilon) / numbers.theta;
            }
            [one, zero, one]
        }
        White::P80 => [one / bounded_gain(measured(statistics.p80)), zero, one],
        White::P90 => {
            let least = match family.law {
                OffsetMode::Added => one,
                OffsetMode::Rescaled => numbers.base_gain,
            };
            [
                measured(statistics.p90),
                black_level(numbers.alpha, numbers.beta, statistics.ratio()),
                least + numbers.gain_c * mean_luminance,
            ]
        }
    };
    PhotographCurve { white, offset, gain, constants }
}

/// delta0 = alpha (1 - r)^beta of a photograph with r = p10 / p90; with beta 0 it is alpha for every photograph.
pub(super) fn black_level<T: Real>(alpha: T, beta: f64, ratio: f64) -> T {
    alpha * T::of((1.0 - ratio).powf(beta))
}

/// The pseudo-GT value in [0, 1] of the sRGB-encoded value `x` under the curve `curve` (a `CURVE_*`), as the kernels of
/// `include/tone.glsl` compute it.
pub(crate) fn tone_curve(curve: u32, x: f32, tone: &ToneParameters) -> f32 {
    clamped(curve_at(curve, x / tone.white, [tone.offset, tone.gain], &tone.constants))
}

/// The curve at t = x / white, unclamped.
pub(crate) fn curve_at<T: Real>(curve: u32, t: T, [offset, gain]: [T; 2], c: &Constants<T>) -> T {
    let one = T::of(1.0);
    match curve {
        CURVE_NONE | CURVE_LINEAR => t,
        CURVE_ASE | CURVE_AUTO => offset + (one - offset) * (gain * t).one_minus_exp(),
        CURVE_AP3 => offset + gain * curve_shape(curve, t, c),
        CURVE_TANH => offset + (one - offset) * (gain * within(t)).tanh(),
        CURVE_ASE_FLOOR => {
            let (t, share, white) = (within(t), c[0], gain.one_minus_exp());
            let scale = (one - offset) * white / ((one - share) * white + share + T::of(1e-8));
            offset + scale * ((one - share) * (gain * t).one_minus_exp() + share * t)
        }
        _ => offset + gain * curve_shape(curve, within(t), c),
    }
}

/// Clamped to [0, 1]; a NaN becomes black.
pub(crate) fn clamped<T: Real>(y: T) -> T {
    if y > T::of(0.0) { y.at_most(T::of(1.0)) } else { T::of(0.0) }
}
