use glam::UVec2;

use super::rounding::UNIT;
use super::splat::{extent_error, splat_tile_rows, splat_tiles};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::ProjectedSplat;
use crate::kernels::emit::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::no_tile::NO_TILE;

/// The tiles that the splat covers, row by row.
fn covered(params: &Params, constants: &Constants, splat: &ProjectedSplat) -> Vec<u32> {
    let tile = UVec2::new(constants.tile_width, constants.tile_height);
    let [top, bottom] = splat_tile_rows(splat, params.size.y, tile);
    let row = |row| {
        let [first, end] = splat_tiles(splat, row, params.size.x, tile);
        (first..end).map(move |column| row * params.tile_columns + column)
    };
    (top..bottom).flat_map(row).collect()
}

/// The Gaussian of every rank with its slots, and whether all of them fit the memory.
fn reserved(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
) -> Vec<(u32, std::ops::Range<u32>, bool)> {
    let ranks = 0..params.gaussian_count as usize;
    let one = |rank: usize| {
        let id = slices.sorted_ids[rank];
        let before = slices.sums[rank / constants.partition_size as usize];
        let first = before.wrapping_add(slices.intersection_offsets[rank]);
        let end = first.wrapping_add(slices.tile_counts[id as usize]);
        let is_whole = first <= end && end <= slices.counts[0];
        (id, first..if is_whole { end } else { first.max(slices.counts[0]) }, is_whole)
    };
    ranks.map(one).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        for (id, reserved, is_whole) in reserved(params, constants, &slices) {
            let first = reserved.start;
            let covered = match is_whole && !reserved.is_empty() {
                true => covered(params, constants, &slices.splats[id as usize]),
                false => vec![],
            };
            let count = reserved.len().min(covered.len()) as u32;
            slices.intersection_ranges[id as usize] = UVec2::new(first, first + count);
            let padding = std::iter::repeat(NO_TILE);
            for (slot, tile) in reserved.zip(covered.into_iter().chain(padding)) {
                slices.tiles[slot as usize] = tile;
                slices.gaussian_ids[slot as usize] = id;
                slices.intersection_ids[slot as usize] = slot;
                if constants.sorts_tiles && tile != NO_TILE {
                    let size = &mut slices.tile_sizes[tile as usize];
                    slices.intersection_ids[slot as usize] = *size;
                    *size += 1;
                }
            }
        }
    }

    /// If an edge of the ellipse is within rounding of an edge of a tile, the Gaussian may or may not cover the tile.
    /// The order of arrival in a tile is any; `place_pairs` shows whether every place is given once.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let mut tiles = vec![0.0; slices.tiles.len()];
        let mut intersection_ranges = vec![0.0; 2 * slices.intersection_ranges.len()];
        let mut uncertain = 0.0;
        for (id, reserved, is_whole) in reserved(params, constants, &slices) {
            if reserved.is_empty() || !is_whole {
                continue;
            }
            let splat = &slices.splats[id as usize];
            let exact = covered(params, constants, splat);
            if moved(splat).iter().any(|splat| covered(params, constants, splat) != exact) {
                tiles[reserved.start as usize..reserved.end as usize].fill(f64::INFINITY);
                intersection_ranges[2 * id as usize + 1] = reserved.len() as f64;
                uncertain += 1.0;
            }
        }
        Tolerances {
            tiles: Tolerance::Each(tiles),
            intersection_ranges: Tolerance::Each(intersection_ranges),
            tile_sizes: Tolerance::Each(vec![uncertain; slices.tile_sizes.len()]),
            intersection_ids: match constants.sorts_tiles {
                true => Tolerance::Each(vec![f64::INFINITY; slices.intersection_ids.len()]),
                false => Tolerance::Exact,
            },
            ..Tolerances::default()
        }
    }
}

/// The splat, with its edges moved by their rounding errors.
fn moved(splat: &ProjectedSplat) -> [ProjectedSplat; 2] {
    let extent = extent_error(splat.opacity) * f64::from(splat.half_extent.x);
    let off = (extent + 8.0 * UNIT * f64::from(splat.mean2d.x.abs())) as f32;
    [-off, off].map(|off| {
        let mut moved = *splat;
        moved.mean2d.x += off;
        moved
    })
}
