use crate::gpu::Reference;
use crate::kernels::sort_spine::{Constants, Kernel, Params, Slices};

/// Turns the counts of every digit, a column of `table` (partitions, digits), into exclusive prefix sums and its total.
pub(super) fn make_prefix_sums(
    table: &mut [u32],
    digit_totals: &mut [u32],
    digit_count: usize,
    partition_count: usize,
) {
    for digit in 0..digit_count {
        let mut running = 0;
        for part in 0..partition_count {
            let keys = table[part * digit_count + digit];
            table[part * digit_count + digit] = running;
            running += keys;
        }
        digit_totals[digit] = running;
    }
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { counts, table, digit_totals } = slices;
        let count = counts[params.count_index as usize].min(params.capacity);
        let partition_count = count.div_ceil(constants.partition_size) as usize;
        make_prefix_sums(table, digit_totals, 1 << params.digit_bits, partition_count);
    }
}
