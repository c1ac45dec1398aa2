use crate::gpu::Reference;
use crate::kernels::tile_begins::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let Slices { tile_sizes, tile_begins } = slices;
        let mut begin = 0;
        for tile in 0..params.tile_count as usize {
            tile_begins[tile] = begin;
            begin += tile_sizes[tile];
            tile_sizes[tile] = 0;
        }
        tile_begins[params.tile_count as usize] = begin;
    }
}
