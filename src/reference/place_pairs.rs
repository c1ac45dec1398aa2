use glam::UVec2;

use crate::gpu::{Reference, Tolerance};
use crate::kernels::no_tile::NO_TILE;
use crate::kernels::place_pairs::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    /// Within a tile in the order of the slots, which shows ranks that occur twice.
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let Slices { counts, tiles, gaussian_ids, depth_keys, tile_begins, pairs, .. } = slices;
        let mut next = tile_begins.to_vec();
        for slot in 0..counts[0].min(params.capacity) {
            let tile = tiles[slot as usize];
            if tile != NO_TILE {
                let depth_key = depth_keys[gaussian_ids[slot as usize] as usize];
                pairs[next[tile as usize] as usize] = UVec2::new(depth_key, slot);
                next[tile as usize] += 1;
            }
        }
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let count = slices.counts[0].min(params.capacity) as usize;
        let tiles = slices.tiles[..count].iter().filter(|&&tile| tile != NO_TILE);
        let tile_count = tiles.max().map_or(0, |last| last + 1);
        Tolerances { pairs: any_order(slices.tile_begins, tile_count) }
    }
}

/// Pairs in any order within each tile. The buffer may be of a view with more tiles.
pub(super) fn any_order(tile_begins: &[u32], tile_count: u32) -> Tolerance {
    let begins = tile_begins[..=tile_count as usize].iter().map(|&begin| begin as usize);
    Tolerance::AnyOrder { width: 2, begins: begins.collect() }
}
