use glam::UVec2;

use super::rounding::UNIT;
use super::splat::{extent_error, splat_tile_rows, splat_tiles};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::ProjectedSplat;
use crate::kernels::emit::{Constants, Kernel, NO_TILE, Params, Slices, Tolerances};

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

/// The rank of every Gaussian that has slots, with these.
fn ranks<'a>(
    params: &Params,
    slices: &'a Slices<'_>,
) -> impl Iterator<Item = (usize, std::ops::Range<usize>)> + use<'a> {
    (0..params.gaussian_count as usize).filter_map(|rank| {
        let first = slices.offsets[rank];
        let end = first.wrapping_add(slices.ordered_counts[rank]);
        let has_slots = end != first && end <= slices.counts[0];
        has_slots.then_some((rank, first as usize..end as usize))
    })
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let all: Vec<_> = ranks(params, &slices).collect();
        for (rank, reserved) in all {
            let id = slices.sorted_ids[rank];
            let covered = covered(params, constants, &slices.splats[id as usize]);
            let padding = std::iter::repeat(NO_TILE);
            for (slot, tile) in reserved.zip(covered.into_iter().chain(padding)) {
                slices.tiles[slot] = tile;
                slices.slots[slot] = slot as u32;
                slices.owners[slot] = id;
            }
        }
    }

    /// Where a border of the ellipse lies within rounding of that of a tile, its Gaussian may or may not cover the tile.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let mut bounds = vec![0.0; slices.tiles.len()];
        for (rank, reserved) in ranks(params, &slices) {
            let splat = &slices.splats[slices.sorted_ids[rank] as usize];
            let exact = covered(params, constants, splat);
            if moved(splat).iter().any(|splat| covered(params, constants, splat) != exact) {
                bounds[reserved].fill(f64::INFINITY);
            }
        }
        Tolerances { tiles: Tolerance::Each(bounds), ..Tolerances::default() }
    }
}

/// The splat, with its borders off by their roundings.
fn moved(splat: &ProjectedSplat) -> [ProjectedSplat; 2] {
    let extent = extent_error(splat.opacity) * f64::from(splat.half_extent.x);
    let off = (extent + 8.0 * UNIT * f64::from(splat.mean2d.x.abs())) as f32;
    [-off, off].map(|off| {
        let mut moved = *splat;
        moved.mean2d.x += off;
        moved
    })
}
