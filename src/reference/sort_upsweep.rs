use crate::gpu::Reference;
use crate::kernels::sort_upsweep::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { counts, keys, table, offsets, digit_begins, .. } = slices;
        let count = counts[params.count_index as usize].min(params.capacity) as usize;
        let (digit_count, per_workgroup) = (1 << params.digit_bits, constants.subgroups as usize);
        let mut totals = vec![0; digit_count];
        for (part, keys) in keys[..count].chunks(constants.partition_size as usize).enumerate() {
            let workgroup = &mut table[part / per_workgroup * digit_count..][..digit_count];
            if part % per_workgroup == 0 {
                workgroup.copy_from_slice(&totals);
            }
            if per_workgroup > 1 {
                for digit in 0..digit_count {
                    offsets[part * digit_count + digit] = totals[digit] - workgroup[digit];
                }
            }
            for key in keys {
                totals[(key >> params.shift) as usize % digit_count] += 1;
            }
        }
        // Without keys, no workgroup is the last.
        if count > 0 {
            let mut before = 0;
            for digit in 0..digit_count {
                digit_begins[digit] = before;
                before += totals[digit];
            }
        }
    }
}
