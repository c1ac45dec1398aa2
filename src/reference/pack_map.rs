//! Feature maps, packed.

use super::packed::PackedOutput;
use super::rounding::Rounded;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::pack_map::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { bound, source, packed }: Slices<'_>) {
        let &Params { size, channels } = params;
        let planes = Rounded::all(source);
        PackedOutput { size, channels, planes, bound: bound[0], pixels_alone: false }.write(packed);
    }

    /// The next half above or below.
    fn tolerances(_: &Params, _: &Constants, _: Slices<'_>) -> Tolerances {
        Tolerances { packed: Tolerance::Halves }
    }
}
