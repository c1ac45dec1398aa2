//! Feature maps, packed.

use super::packed::write;
use super::widen;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::pack_map::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { bound, source, packed }: Slices<'_>) {
        write(params.size, params.channels, &widen(source), bound[0], false, packed);
    }

    /// The next half above or below.
    fn tolerances(_: &Params, _: &Constants, _: Slices<'_>) -> Tolerances {
        Tolerances { packed: Tolerance::Halves }
    }
}
