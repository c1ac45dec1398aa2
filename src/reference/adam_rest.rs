use super::adam::{from_halves, in_halves, moments_after, stepped};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::adam_rest::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::half::{LARGEST_HALF, SMALLEST_HALF};
use crate::splats::attributes::{Attribute, AttributePlane};
use crate::splats::batches::frozen_floats;
use crate::splats::packed_sh::value;

/// Rounds to a multiple of the half's unit, up or down depending on `chance`; returns the bits of a half.
fn rounded_by_chance(x: f32, chance: u32) -> u16 {
    let (smallest, largest) = (SMALLEST_HALF as f32, LARGEST_HALF as f32);
    let exponent = x.to_bits() & 0x7f80_0000;
    let below = exponent < smallest.to_bits();
    let unit = if below { smallest } else { f32::from_bits(exponent - (10 << 23)) };
    let share = (chance >> 19) as f32 / 8192.0;
    // A multiple is a half, so rounding to nearest keeps it.
    crate::splats::packed_sh::nearest(((x / unit + share).floor() * unit).clamp(-largest, largest))
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { parameters, gradients, first_moments, second_moments, both_moments, status } =
            slices;
        if status[0] != 0 {
            return;
        }
        let (count, coefficients) =
            (params.gaussian_count as usize, params.coefficient_count as usize);
        let left_out = frozen_floats(constants.frozen_columns, count);
        let (attribute, column) = (Attribute::Rest, params.first_column as usize);
        let rest = |width, i, k| {
            let plane = AttributePlane { attribute, column, width };
            plane.index(constants.rest_by_column, count, i, k)
        };
        for (i, k) in (0..count).flat_map(|i| (0..coefficients).map(move |k| (i, k))) {
            let (at, word) =
                (rest(coefficients, i, k) - left_out, rest(coefficients.div_ceil(2), i, k / 2));
            let [m, v] = match constants.half_moments {
                true => from_halves(both_moments[at]),
                false => [first_moments[at], second_moments[at]],
            };
            let shift = 16 * (k % 2);
            let before = [value((parameters[word] >> shift) as u16), gradients[at], m, v];
            let [after, ..] = stepped::<f64>([params.rate, params.second_correction], before);
            let (moments, chance) = moments_after(params.step, before);
            let half = u32::from(rounded_by_chance(after as f32, chance));
            parameters[word] = parameters[word] & !(0xffff << shift) | half << shift;
            if k + 1 == coefficients && shift == 0 {
                parameters[word] &= 0xffff;
            }
            if constants.half_moments {
                both_moments[at] = in_halves(moments, chance);
            } else {
                [first_moments[at], second_moments[at]] = moments;
            }
        }
    }

    /// A value close to the threshold of rounding up may be rounded down. Moments are rounded equally everywhere,
    /// except for subnormal ones, which may be flushed to zero.
    fn tolerances(_: &Params, constants: &Constants, _: Slices<'_>) -> Tolerances {
        let parameters = Tolerance::Halves;
        if constants.half_moments {
            return Tolerances { parameters, ..Tolerances::default() };
        }
        let [first_moments, second_moments] = [(); 2].map(|()| Tolerance::Roundings(0.0));
        Tolerances { parameters, first_moments, second_moments, ..Tolerances::default() }
    }
}
