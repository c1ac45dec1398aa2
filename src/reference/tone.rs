//! The tone curves of `include/tone.glsl`, for any [`Real`] in the shader's order of operations.

use super::curves::{LARGEST_T, MAX_CONSTANTS, curve_shape};
use super::real::Real;
use super::rounding::Rounded;
use crate::kernels::ToneParameters;
pub use crate::kernels::{
    CURVE_AP3, CURVE_ASE, CURVE_ASE_FLOOR, CURVE_LINEAR, CURVE_LUM_PRESERVE, CURVE_NONE, CURVE_P80,
    CURVE_PER_CHANNEL, CURVE_TANH,
};

/// The pseudo-GT value in [0, 1] of the sRGB-encoded value `x` under the curve `curve` (a `CURVE_*`).
pub fn tone_curve(curve: u32, x: f32, tone: &ToneParameters) -> f32 {
    clamped(curve_at(curve, x / tone.white, [tone.offset, tone.gain], &tone.constants))
}

/// The same, and what single precision may make of it.
pub(super) fn rounded_tone_curve(curve: u32, x: f32, tone: &ToneParameters) -> Rounded {
    let [x, white, offset, gain] = [x, tone.white, tone.offset, tone.gain].map(Rounded::exact);
    let y = curve_at(curve, x / white, [offset, gain], &tone.constants.map(Rounded::exact));
    y.at_least(Rounded::of(0.0)).at_most(Rounded::of(1.0))
}

/// The curve at t = x / white, before it is clamped.
pub fn curve_at<T: Real>(curve: u32, t: T, [offset, gain]: [T; 2], c: &[T; MAX_CONSTANTS]) -> T {
    let one = T::of(1.0);
    match curve {
        CURVE_NONE | CURVE_LINEAR => t,
        CURVE_ASE => offset + (one - offset) * (gain * t).one_minus_exp(),
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

/// What lies outside (0, [`LARGEST_T`]), or is no number, counts as the end it is at, a NaN as black.
pub fn within<T: Real>(t: T) -> T {
    if t > T::of(0.0) { t.at_most(T::of(LARGEST_T)) } else { T::of(0.0) }
}

/// Within [0, 1]; a NaN becomes black.
pub fn clamped<T: Real>(y: T) -> T {
    if y > T::of(0.0) { y.at_most(T::of(1.0)) } else { T::of(0.0) }
}
