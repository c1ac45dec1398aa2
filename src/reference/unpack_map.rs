//! Packed feature maps, unpacked.

use super::packed::{scale, unpacked};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::unpack_map::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { bound, packed, target }: Slices<'_>) {
        let values = unpacked(params.size, params.channels, packed, bound[0]);
        target[..values.len()].copy_from_slice(&values);
    }

    /// Subnormal halves may be flushed.
    fn tolerances(_: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let flushed = f64::exp2(-14.0) / scale(slices.bound[0]);
        Tolerances { target: Tolerance::Each(vec![flushed; slices.target.len()]) }
    }
}
