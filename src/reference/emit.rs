use glam::UVec2;

use super::splat::{splat_tile_rows, splat_tiles};
use crate::gpu::Reference;
use crate::kernels::emit::{Constants, Kernel, NO_TILE, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { counts, sorted_ids, ordered_counts, offsets, splats, tiles, slots, owners } =
            slices;
        let tile = UVec2::new(constants.tile_width, constants.tile_height);
        for rank in 0..params.gaussian_count as usize {
            let first = offsets[rank] as usize;
            let reserved = ordered_counts[rank] as usize;
            if reserved == 0 || first + reserved > counts[0] as usize {
                continue;
            }
            let id = sorted_ids[rank];
            let splat = &splats[id as usize];
            let [top, bottom] = splat_tile_rows(splat, params.size.y, tile);
            let covered = (top..bottom).flat_map(|row| {
                let [first, end] = splat_tiles(splat, row, params.size.x, tile);
                (first..end).map(move |column| row * params.tile_columns + column)
            });
            let padding = std::iter::repeat(NO_TILE);
            for (slot, tile) in (first..first + reserved).zip(covered.chain(padding)) {
                tiles[slot] = tile;
                slots[slot] = slot as u32;
                owners[slot] = id;
            }
        }
    }
}
