use crate::gpu::Reference;
use crate::kernels::tile_ranges::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { counts, sorted_tiles, tile_ranges }: Slices<'_>,
    ) {
        let count = counts[0] as usize;
        for i in 0..count {
            let tile = sorted_tiles[i];
            if tile >= params.tile_count {
                continue;
            }
            if i == 0 || sorted_tiles[i - 1] != tile {
                tile_ranges[tile as usize].x = i as u32;
            }
            if i + 1 == count || sorted_tiles[i + 1] != tile {
                tile_ranges[tile as usize].y = i as u32 + 1;
            }
        }
    }
}
