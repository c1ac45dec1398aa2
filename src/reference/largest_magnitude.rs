//! The largest magnitude, as bits.

use crate::gpu::Reference;
use crate::kernels::largest_magnitude::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { values, largest }: Slices<'_>) {
        let own = &values[params.offset as usize..][..params.value_count as usize];
        largest[0] = own.iter().map(|value| value.abs().to_bits()).fold(largest[0], u32::max);
    }

    fn tolerances(_: &Params, _: &Constants, _: Slices<'_>) -> Tolerances {
        Tolerances::default()
    }
}
