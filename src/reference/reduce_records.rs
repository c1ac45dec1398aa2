use crate::gpu::Reference;
use crate::kernels::reduce_records::{Constants, Kernel, Params, Slices};
use crate::kernels::splat::RECORD_HEAD;

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { counts, sorted_ids, ordered_counts, offsets, records, d_splats } = slices;
        let record = (RECORD_HEAD + constants.channels) as usize;
        for rank in 0..params.gaussian_count as usize {
            let d_splat = &mut d_splats[record * sorted_ids[rank] as usize..][..record];
            d_splat.fill(0.0);
            let first = offsets[rank] as usize;
            let end = first + ordered_counts[rank] as usize;
            if end > counts[0] as usize {
                continue;
            }
            for slot in first..end {
                for k in 0..record {
                    d_splat[k] += records[record * slot + k];
                }
            }
        }
    }
}
