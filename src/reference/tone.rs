//! The tone curves of `include/tone.glsl`, in the shader's order of operations.

use crate::kernels::ToneParameters;

/// `CURVE_NONE` of `include/tone.glsl`: the photograph as it is.
pub const CURVE_NONE: u32 = 0;
/// `CURVE_LINEAR`: x theta / mean.
pub const CURVE_LINEAR: u32 = 1;
/// `CURVE_ASE`: adaptive soft exponential.
pub const CURVE_ASE: u32 = 2;
/// `CURVE_AP3`: adaptive cubic.
pub const CURVE_AP3: u32 = 3;

/// The pseudo-GT value in [0, 1] of the sRGB-encoded value `x` under the curve `curve` (a `CURVE_*`).
/// A NaN becomes 0.
pub fn tone_curve(curve: u32, x: f32, tone: &ToneParameters) -> f32 {
    let t = x / tone.white;
    let y = match curve {
        CURVE_ASE => tone.offset + (1.0 - tone.offset) * one_minus_exp(tone.gain * t),
        CURVE_AP3 => tone.offset + tone.gain * (((0.0720 * t - 0.4376) * t + 0.9948) * t),
        _ => t,
    };
    if y > 0.0 { y.min(1.0) } else { 0.0 }
}

/// 1 - exp(-x) for x >= 0, without cancellation where x is tiny.
fn one_minus_exp(x: f32) -> f32 {
    if x < 0.01 { x * (1.0 - x * (0.5 - x * (1.0 / 6.0))) } else { 1.0 - (-x).exp() }
}
