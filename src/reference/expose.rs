//! Application of an exposure, in any number type.

use nightsplat_photographs::tone::Real;

use super::rounding::{Rounded, bounded_reference};
use crate::kernels::expose::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::exposure::{BIAS_SCALE, CLIPPED_REACH, EXPOSURE_WIDTH};

/// Gain and bias of a channel of a view, in any number type.
pub fn gain_and_bias<T: Real>(exposures: &[T], view: usize, channel: usize) -> [T; 2] {
    let at = view * EXPOSURE_WIDTH as usize + channel;
    [exposures[at].exp(), T::from_f64(BIAS_SCALE) * exposures[at + 3]]
}

/// Whether a target is clipped at that of white.
pub(super) fn is_clipped(target: f32, white: f32) -> bool {
    (target - white).abs() <= CLIPPED_REACH as f32
}

/// Every value written.
fn exposed(
    params: &Params,
    &Constants { inverse }: &Constants,
    slices: &Slices<'_>,
) -> [Vec<Rounded>; 1] {
    let (pixels, view) = (params.pixel_count as usize, params.view as usize);
    let exposures = Rounded::all(slices.exposures);
    let value = |(i, &value): (usize, &f32)| {
        let channel = i / pixels;
        let [gain, bias] = gain_and_bias(&exposures, view, channel);
        let value = Rounded::exact(value);
        if inverse {
            return (value - bias) / gain;
        }
        let exposed = gain * value + bias;
        let target = slices.target[i];
        match is_clipped(target, slices.whites[3 * view + channel]) {
            true => exposed.at_most(Rounded::exact(target)),
            false => exposed,
        }
    };
    [slices.render[..3 * pixels].iter().enumerate().map(value).collect()]
}

bounded_reference!(exposed: exposed);
