use crate::gpu::Reference;
use crate::kernels::sort_downsweep::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices {
            counts,
            table,
            offsets,
            digit_begins,
            keys,
            values,
            sorted_keys,
            sorted_values,
        } = slices;
        let count = counts[params.count_index as usize].min(params.capacity) as usize;
        let partition_size = constants.partition_size as usize;
        let digit_count = 1 << params.digit_bits;
        for part in 0..count.div_ceil(partition_size) {
            let workgroup = part / constants.subgroups as usize;
            let mut next_place = vec![0; digit_count];
            for digit in 0..digit_count {
                next_place[digit] = digit_begins[digit] + table[workgroup * digit_count + digit];
                if constants.subgroups > 1 {
                    next_place[digit] += offsets[part * digit_count + digit];
                }
            }
            for i in part * partition_size..count.min((part + 1) * partition_size) {
                let digit = (keys[i] >> params.shift) as usize % digit_count;
                let place = next_place[digit] as usize;
                next_place[digit] += 1;
                sorted_keys[place] = keys[i];
                sorted_values[place] = values[i];
            }
        }
    }
}
