//! The value of a curve at x. It is generic over the number type: f64 for the kernels' parameters, dual numbers for the
//! derivatives of a fit, f32 for the kernels' references.

use super::*;

/// The pseudo-GT value of the sRGB-encoded value `x` under the curve `curve` (a `CURVE_*`), as the kernels of
/// `include/tone.glsl` compute it: in [0, 1] from 0 on, and [`mirrored`] below.
pub fn tone_curve(curve: u32, x: f32, tone: &ToneParameters) -> f32 {
    let scale = [tone.offset, tone.gain];
    mirrored(x, |x| clamped(curve_at(curve, x / tone.white, scale, &tone.constants)))
}

/// A curve T below 0, where noise at black is: 2 T(0) - T(-x). It goes on with its slope at 0, and noise that is
/// symmetric has no bias there; a straight line would have one wherever the curve bends within the noise.
pub fn mirrored<T: Real>(x: T, curve: impl Fn(T) -> T) -> T {
    let zero = T::from_f64(0.0);
    if x < zero { T::from_f64(2.0) * curve(zero) - curve(-x) } else { curve(x) }
}

/// A value within `most` of 0; a NaN counts as 0.
pub fn bounded(x: f32, most: f32) -> f32 {
    if x.is_nan() { 0.0 } else { x.clamp(-most, most) }
}

/// The curve at t = x / white, unclamped.
pub fn curve_at<T: Real>(curve: u32, t: T, [offset, gain]: [T; 2], c: &Constants<T>) -> T {
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
pub fn clamped<T: Real>(y: T) -> T {
    if y > T::from_f64(0.0) { y.at_most(T::from_f64(1.0)) } else { T::from_f64(0.0) }
}

/// S(t) = 1 - exp(-u) with u = ln(1 + s t) / s, or t for s = 0.
pub fn shoulder<T: Real>(t: T, s: T) -> T {
    if s > T::from_f64(0.0) { ((s * t).ln_1p() / s).one_minus_exp() } else { t.one_minus_exp() }
}

/// The toe: from `black` to 0 and from `end` to itself, with a quarter of the slope of a line at black; values above
/// `end`, and all of weight 0, are unchanged. Values below `black` are mirrored.
pub fn toe<T: Real>(value: T, black: T, [end, weight]: [T; 2]) -> T {
    if !(weight > T::from_f64(0.0) && value < end) {
        return value;
    }
    let [zero, one, two, quarter] = [0.0, 1.0, 2.0, 0.25].map(T::from_f64);
    let s = (value - black) / (end - black);
    if s > -one {
        let size = if s < zero { -s } else { s };
        value + weight * (end * s * (quarter + (one - quarter) * size) - value)
    } else {
        // The mirror of what is above the toe.
        value - two * weight * black
    }
}
