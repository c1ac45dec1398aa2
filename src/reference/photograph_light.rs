//! A render in the values of its photographs, by the inverse of the host.

use nightsplat_photographs::tone::InverseTone;

use super::rounding::{Rounded, UNIT, rounded_tone_curve};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::curves::{CURVE_AUTO, CURVE_LUM_PRESERVE, CURVE_PER_CHANNEL};
use crate::kernels::photograph_light::{Constants, Kernel, PRECISION, Params, Slices, Tolerances};

/// Roundings of the curve and of the quotient by alpha, in values of at most 1.
const ROUNDINGS: f64 = 32.0;

fn inverse(params: &Params, constants: &Constants) -> InverseTone {
    InverseTone::of_curve(constants.tone_curve, None, &params.tone)
}

/// The colour of a pixel before its coverage, and alpha; `None` where nothing is seen.
fn pixel(params: &Params, slices: &Slices<'_>, at: usize) -> Option<([f64; 3], f64)> {
    let alpha = 1.0 - f64::from(slices.transmittances[at]);
    let count = params.pixel_count as usize;
    let color = [0, 1, 2].map(|c| f64::from(slices.render[c * count + at]) / alpha);
    (alpha > 0.0).then_some((color, alpha))
}

/// How far the device's curve may be from the target `value` at the solution `x`.
fn residual(params: &Params, constants: &Constants, x: f64, value: f64) -> f64 {
    let curve = match constants.tone_curve {
        CURVE_AUTO | CURVE_LUM_PRESERVE | CURVE_PER_CHANNEL => Rounded::default(),
        curve => rounded_tone_curve(curve, x as f32, &params.tone),
    };
    // Newton's method ends twice at this precision, within a channel and in luminance.
    curve.error + ROUNDINGS * UNIT + 2.0 * PRECISION * value.abs()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let (inverse, count) = (inverse(params, constants), params.pixel_count as usize);
        for at in 0..count {
            let Some((color, alpha)) = pixel(params, &slices, at) else { continue };
            for (c, x) in inverse.invert(inverse.shown(color)).into_iter().enumerate() {
                slices.render[c * count + at] = (x * alpha) as f32;
            }
        }
    }

    /// A target that is off by the rounding of the curve has another solution. More of any channel of a target is more
    /// of every channel of its photograph, so the solutions of targets that are off in all channels bound the error.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let (inverse, count) = (inverse(params, constants), params.pixel_count as usize);
        let mut render = vec![0.0; 3 * count];
        for at in 0..count {
            let Some((color, alpha)) = pixel(params, &slices, at) else { continue };
            // Beyond the largest value that is inverted, the solution is that of this value.
            let color = inverse.bounded(inverse.shown(color));
            let found = inverse.invert(color);
            let off = [0, 1, 2].map(|c| residual(params, constants, found[c], color[c]));
            let moved = |sign: f64| {
                inverse.invert(inverse.shown([0, 1, 2].map(|c| color[c] + sign * off[c])))
            };
            let (low, high) = (moved(-1.0), moved(1.0));
            for c in 0..3 {
                let bound = 2.0 * (found[c] - low[c]).max(high[c] - found[c]);
                // Bisection ends at its precision, and after some halvings.
                let solved = 2.0 * PRECISION * found[c] + 1e-14;
                render[c * count + at] = alpha * (bound + solved + 8.0 * UNIT * found[c]);
            }
        }
        Tolerances { render: Tolerance::Each(render) }
    }
}
