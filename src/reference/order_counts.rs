use crate::gpu::Reference;
use crate::kernels::order_counts::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { sorted_ids, tile_counts, ordered_counts }: Slices<'_>,
    ) {
        for rank in 0..params.gaussian_count as usize {
            ordered_counts[rank] = tile_counts[sorted_ids[rank] as usize];
        }
    }
}
