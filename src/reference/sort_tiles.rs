use super::place_pairs::any_order;
use crate::gpu::Reference;
use crate::kernels::no_tile::NO_TILE;
use crate::kernels::sort_tiles::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let Slices { counts, tile_begins, pairs, sorted_tiles, sorted_intersections } = slices;
        for tile in 0..params.tile_count {
            let [begin, end] = [0, 1].map(|next| tile_begins[tile as usize + next] as usize);
            let mut of_tile = pairs[begin..end].to_vec();
            of_tile.sort_unstable_by_key(|pair| (pair.x, pair.y));
            sorted_tiles[begin..end].fill(tile);
            for (sorted, pair) in sorted_intersections[begin..end].iter_mut().zip(of_tile) {
                *sorted = pair.y;
            }
        }
        let padding = tile_begins[params.tile_count as usize] as usize..counts[0] as usize;
        sorted_tiles[padding.clone()].fill(NO_TILE);
        sorted_intersections[padding].fill(0);
    }

    /// The pairs of tiles that shared memory does not hold are sorted where they are.
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances {
            pairs: any_order(slices.tile_begins, params.tile_count),
            ..Tolerances::default()
        }
    }
}
