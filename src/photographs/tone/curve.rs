//! The curve of one photograph: its numbers, and its value at x. It is generic over the number type: f64 for the
//! kernels' parameters, dual numbers for the derivatives of a fit, f32 for the kernels' references.

use super::families::{Constants, curve_shape};
use super::metering::{shoulder, toe};
use super::real::{Real, within};
use crate::kernels::ToneParameters;
use crate::kernels::curves::*;

/// A setting that a curve is a function of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Variable {
    /// A constant of the formula.
    Constant(usize),
    Theta,
    Alpha,
    GainC,
    BaseGain,
}

/// The curve of one photograph in any number type; [`ToneParameters`] are its numbers on the device.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Curve<T> {
    /// A `CURVE_*` number.
    pub(crate) number: u32,
    /// The value that t = 1 corresponds to.
    pub(crate) white: T,
    pub(crate) offset: T,
    pub(crate) gain: T,
    /// The first three are the white of each channel, if channels differ.
    pub(crate) constants: Constants<T>,
}

impl<T: Real> Curve<T> {
    /// Its value at the sRGB-encoded value `x`, unclamped.
    pub(crate) fn at(&self, x: T) -> T {
        curve_at(self.number, x / self.white, [self.offset, self.gain], &self.constants)
    }
}

/// The pseudo-GT value of the sRGB-encoded value `x` under the curve `curve` (a `CURVE_*`), as the kernels of
/// `include/tone.glsl` compute it: in [0, 1] from 0 on, and [`mirrored`] below.
pub(crate) fn tone_curve(curve: u32, x: f32, tone: &ToneParameters) -> f32 {
    let scale = [tone.offset, tone.gain];
    mirrored(x, |x| clamped(curve_at(curve, x / tone.white, scale, &tone.constants)))
}

/// A curve T below 0, where noise at black is: 2 T(0) - T(-x). It goes on with its slope at 0, and noise that is
/// symmetric has no bias there; a straight line would have one wherever the curve bends within the noise.
pub(crate) fn mirrored<T: Real>(x: T, curve: impl Fn(T) -> T) -> T {
    let zero = T::from_f64(0.0);
    if x < zero { T::from_f64(2.0) * curve(zero) - curve(-x) } else { curve(x) }
}

/// A value within `most` of 0; a NaN counts as 0.
pub(crate) fn bounded(x: f32, most: f32) -> f32 {
    if x.is_nan() { 0.0 } else { x.clamp(-most, most) }
}

/// The curve at t = x / white, unclamped.
pub(crate) fn curve_at<T: Real>(curve: u32, t: T, [offset, gain]: [T; 2], c: &Constants<T>) -> T {
    let one = T::from_f64(1.0);
    match curve {
        CURVE_NONE | CURVE_LINEAR => t,
        CURVE_ASE => offset + (one - offset) * (gain * t).one_minus_exp(),
        CURVE_AUTO => toe(offset + (one - offset) * shoulder(t, c[1]), offset, [c[2], c[3]]),
        CURVE_AP3 => offset + gain * curve_shape(curve, t, c),
        CURVE_TANH => offset + (one - offset) * (gain * within(t)).tanh(),
        CURVE_ASE_FLOOR => {
            let (t, share, white) = (within(t), c[0], gain.one_minus_exp());
            let scale =
                (one - offset) * white / ((one - share) * white + share + T::from_f64(1e-8));
            offset + scale * ((one - share) * (gain * t).one_minus_exp() + share * t)
        }
        _ => offset + gain * curve_shape(curve, within(t), c),
    }
}

/// Clamped to [0, 1]; a NaN becomes black.
pub(crate) fn clamped<T: Real>(y: T) -> T {
    if y > T::from_f64(0.0) { y.at_most(T::from_f64(1.0)) } else { T::from_f64(0.0) }
}
