use super::sort_spine::make_prefix_sums;
use crate::gpu::Reference;
use crate::kernels::sort_upsweep::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { counts, keys, table, digit_totals, .. } = slices;
        let count = counts[params.count_index as usize].min(params.capacity) as usize;
        let partitions = keys[..count].chunks(constants.partition_size as usize);
        let (digit_count, partition_count) = (1 << params.digit_bits, partitions.len());
        table[..digit_count * partition_count].fill(0);
        for (part, keys) in partitions.enumerate() {
            for key in keys {
                let digit = (key >> params.shift) as usize % digit_count;
                table[part * digit_count + digit] += 1;
            }
        }
        // Without items, no workgroup is the last.
        if params.folds_spine != 0 && partition_count > 0 {
            make_prefix_sums(table, digit_totals, digit_count, partition_count);
        }
    }
}
