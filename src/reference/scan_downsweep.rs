use crate::gpu::Reference;
use crate::kernels::scan_downsweep::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { counts, values, sums, offsets } = slices;
        let count = counts[params.count_index as usize].min(params.capacity) as usize;
        let partition_size = constants.partition_size as usize;
        for part in 0..count.div_ceil(partition_size) {
            let mut running = sums[part];
            for i in part * partition_size..count.min((part + 1) * partition_size) {
                offsets[i] = running;
                running = running.wrapping_add(values[i]);
            }
        }
    }
}
