use crate::gpu::Reference;
use crate::kernels::digit::MAX_DIGITS;
use crate::kernels::sort_upsweep::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { counts, keys, table, digit_begins, .. } = slices;
        let count = counts[params.count_index as usize].min(params.capacity) as usize;
        let (digit_count, subgroups) = (1 << params.digit_bits, constants.subgroups as usize);
        let per_workgroup = constants.partition_size as usize * subgroups;
        if subgroups > 1 && params.next_table != 0 {
            let cleared = count.div_ceil(per_workgroup) * MAX_DIGITS as usize;
            table[params.next_table as usize..][..cleared].fill(0);
        }
        let workgroups = table.chunks_mut(digit_count);
        for (counts, keys) in workgroups.zip(keys[..count].chunks(per_workgroup)) {
            counts.fill(0);
            for key in keys {
                counts[(key >> params.shift) as usize % digit_count] += 1;
            }
        }
        let workgroups = count.div_ceil(per_workgroup);
        sum_table(&mut table[..workgroups * digit_count], digit_begins, digit_count);
    }
}

/// Turns the counts of workgroups, (workgroups, digits), into exclusive prefix sums over the workgroups, and finds
/// where the keys of each digit begin. Without keys, no workgroup is the last, which does that.
pub(super) fn sum_table(table: &mut [u32], digit_begins: &mut [u32], digit_count: usize) {
    let mut totals = vec![0; digit_count];
    for counts in table.chunks_mut(digit_count) {
        for (total, count) in totals.iter_mut().zip(counts) {
            *total += std::mem::replace(count, *total);
        }
    }
    if !table.is_empty() {
        let mut before = 0;
        for (begin, total) in digit_begins.iter_mut().zip(totals) {
            *begin = before;
            before += total;
        }
    }
}
