use crate::gpu::Reference;
use crate::kernels::sort_spine::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { counts, table, digit_totals } = slices;
        let count = counts[params.count_index as usize].min(params.capacity);
        let partition_count = count.div_ceil(constants.partition_size) as usize;
        for digit in 0..1 << params.digit_bits {
            let mut running = 0;
            for i in digit * partition_count..(digit + 1) * partition_count {
                let keys = table[i];
                table[i] = running;
                running += keys;
            }
            digit_totals[digit] = running;
        }
    }
}
