//! The weights of a layer, packed.

use super::packed::{channels, eight, scale};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::pack_weights::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { bound, values, packed } = slices;
        let Params { in_channels, out_channels, offset } = *params;
        let (is_transposed, scale) = (constants.transposed, scale(bound[0]));
        let [from, to] =
            if is_transposed { [out_channels, in_channels] } else { [in_channels, out_channels] };
        let [from_padded, to_padded] = [from, to].map(channels);
        let weight = |tap: u32, o: u32, i: u32| {
            if o >= to || i >= from {
                return 0.0;
            }
            let at = match is_transposed {
                true => (i * in_channels + o) * 9 + (8 - tap),
                false => (o * in_channels + i) * 9 + tap,
            };
            scale * f64::from(values[(offset + at) as usize])
        };
        for i in 0..9 * to_padded * from_padded / 8 {
            let (first, row) = (8 * i % from_padded, 8 * i / from_padded);
            packed[i as usize] =
                eight(|from| weight(row / to_padded, row % to_padded, first + from));
        }
    }

    /// The next half above or below.
    fn tolerances(_: &Params, _: &Constants, _: Slices<'_>) -> Tolerances {
        Tolerances { packed: Tolerance::Halves }
    }
}
