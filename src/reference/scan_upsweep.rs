use crate::gpu::Reference;
use crate::kernels::scan_upsweep::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, Slices { counts, values, sums }: Slices<'_>) {
        let count = counts[params.count_index as usize].min(params.capacity) as usize;
        let partitions = values[..count].chunks(constants.partition_size as usize);
        for (part, values) in partitions.enumerate() {
            sums[part] = values.iter().fold(0, |sum: u32, &value| sum.wrapping_add(value));
        }
    }
}
