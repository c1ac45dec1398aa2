use crate::gpu::Reference;
use crate::kernels::order_counts::{Constants, Kernel, Params, Slices};
use crate::kernels::status::STATUS_OVERFLOWED;

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { sorted_ids, tile_counts, intersection_offsets, sums, counts, status, .. } =
            slices;
        let (count, partition_size) =
            (params.gaussian_count as usize, constants.partition_size as usize);
        sums[0] = 0;
        let (mut total, mut before) = (0u64, 0u32);
        for rank in 0..count {
            if rank % partition_size == 0 {
                sums[rank / partition_size] = total as u32;
                before = 0;
            }
            let count = tile_counts[sorted_ids[rank] as usize];
            intersection_offsets[rank] = before;
            before = before.wrapping_add(count);
            total += u64::from(count);
        }
        let whole = u32::try_from(total);
        let total = whole.unwrap_or(u32::MAX);
        let fits = total <= params.capacity;
        let truncates = params.truncates != 0;
        counts[0] = match (fits, truncates, whole) {
            (true, ..) => total,
            (false, true, Ok(_)) => params.capacity,
            _ => 0,
        };
        if !fits && !truncates {
            status[0] |= STATUS_OVERFLOWED;
        }
        status[3] = status[0];
        status[1] = status[1].max(total);
    }
}
