use super::sort_upsweep::sum_table;
use crate::gpu::Reference;
use crate::kernels::digit::MAX_DIGITS;
use crate::kernels::sort_downsweep::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { counts, table, digit_begins, keys, values, .. } = slices;
        let (sorted_keys, sorted_values) = (slices.sorted_keys, slices.sorted_values);
        let count = counts[params.count_index as usize].min(params.capacity) as usize;
        let per_workgroup = (constants.partition_size * constants.subgroups) as usize;
        let workgroups = count.div_ceil(per_workgroup);
        let [digit_count, next_count] = [params.digit_bits, params.next_bits].map(|bits| 1 << bits);
        let counts_next = constants.subgroups > 1 && params.next_bits > 0;
        if counts_next {
            let cleared = workgroups * MAX_DIGITS as usize;
            table[params.cleared_table as usize..][..cleared].fill(0);
        }
        for workgroup in 0..workgroups {
            let sums = &table[params.own_table as usize + workgroup * digit_count..];
            let mut next_place: Vec<u32> =
                digit_begins.iter().zip(sums).take(digit_count).map(|(a, b)| a + b).collect();
            for i in workgroup * per_workgroup..count.min((workgroup + 1) * per_workgroup) {
                let digit = (keys[i] >> params.shift) as usize % digit_count;
                let to = next_place[digit] as usize;
                next_place[digit] += 1;
                sorted_keys[to] = keys[i];
                sorted_values[to] = values[i];
            }
        }
        if counts_next {
            let next = &mut table[params.next_table as usize..][..workgroups * next_count];
            for (counts, keys) in
                next.chunks_mut(next_count).zip(sorted_keys[..count].chunks(per_workgroup))
            {
                for key in keys {
                    counts[(key >> (params.shift + params.digit_bits)) as usize % next_count] += 1;
                }
            }
            sum_table(next, digit_begins, next_count);
        }
    }
}
