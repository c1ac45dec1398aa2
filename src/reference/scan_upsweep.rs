use crate::gpu::Reference;
use crate::kernels::scan_upsweep::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { counts, values, sums, total, .. } = slices;
        let count = counts[params.count_index as usize].min(params.capacity) as usize;
        let partition_size = constants.partition_size as usize;
        let mut running: u32 = 0;
        for part in 0..count.div_ceil(partition_size).max(1) {
            sums[part] = running;
            for i in part * partition_size..count.min((part + 1) * partition_size) {
                running = running.wrapping_add(values[i]);
            }
        }
        total[0] = running;
    }
}
