//! The largest magnitude, as bits.

use crate::gpu::Reference;
use crate::kernels::largest_magnitude::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { values, largest }: Slices<'_>) {
        let values = &values[params.offset as usize..][..params.value_count as usize];
        largest[0] = values.iter().map(|value| value.abs().to_bits()).fold(largest[0], u32::max);
    }
}
