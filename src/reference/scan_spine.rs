use crate::gpu::Reference;
use crate::kernels::scan_spine::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, Slices { counts, sums, total }: Slices<'_>) {
        let count = counts[params.count_index as usize].min(params.capacity);
        let mut running: u32 = 0;
        for part in 0..count.div_ceil(constants.partition_size) as usize {
            let sum = sums[part];
            sums[part] = running;
            running = running.wrapping_add(sum);
        }
        total[0] = running;
    }
}
