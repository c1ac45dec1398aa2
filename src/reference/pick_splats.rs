use glam::{DVec2, UVec2};

use super::blend_forward::{TileList, median};
use super::blending::PixelModel;
use super::splat::fragments;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::pick_splats::{Constants, Kernel, NO_SPLAT, Params, Slices, Tolerances};

/// Calls `visit` with every pixel, its centre, the ids of the splats of its tile, and their list as far as they are
/// seen.
fn for_each_pixel(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
    mut visit: impl FnMut(usize, DVec2, &[u32], &TileList),
) {
    let tile = UVec2::new(constants.tile_width, constants.tile_height);
    for i in 0..params.pixel_count {
        let at = params.first_pixel + i;
        let pixel = UVec2::new(at % params.size.x, at / params.size.x);
        let of_tile = pixel / tile;
        let range = slices.tile_ranges[(of_tile.y * params.tile_columns + of_tile.x) as usize];
        let run = &slices.sorted_intersections[range.x as usize..range.y as usize];
        let Slices { gaussian_ids, splats, colors, .. } = slices;
        let mut list = TileList::new(constants.channels, run, gaussian_ids, splats, colors);
        let is_seen = |&splat: &usize| {
            // A limit that is not a number hides nothing.
            let is_hidden_by = |limit: f32| list.depth(splat) > limit.into();
            params.has_limits == 0 || !is_hidden_by(slices.limits[at as usize])
        };
        let seen = (0..list.splats.len()).take_while(is_seen).count();
        list.splats.truncate(seen);
        list.colors.truncate(seen * constants.channels as usize);
        let ids: Vec<u32> = run.iter().map(|&slot| gaussian_ids[slot as usize]).collect();
        visit(i as usize, pixel.as_dvec2() + 0.5, &ids, &list);
    }
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, mut slices: Slices<'_>) {
        let picks = std::mem::take(&mut slices.picks);
        for_each_pixel(params, constants, &slices, |i, center, ids, list| {
            let seen = fragments(&list.splats, center, constants.alpha_max.into()).0;
            let half = seen.iter().find(|splat| splat.before * (1.0 - splat.alpha) <= 0.5);
            let (id, depth) = match half {
                Some(splat) => (ids[splat.index], (list.depth(splat.index) as f32).to_bits()),
                None => (NO_SPLAT, 0),
            };
            (picks[2 * i], picks[2 * i + 1]) = (id, depth);
        });
    }

    /// Any splat, where a rounding decides.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let alpha_max = constants.alpha_max.into();
        let tile = UVec2::new(constants.tile_width, constants.tile_height);
        let mut picks = vec![0.0; 2 * params.pixel_count as usize];
        for_each_pixel(params, constants, &slices, |i, center, _, list| {
            let error = PixelModel::new(&list.splats, center, alpha_max, tile).error;
            let seen = fragments(&list.splats, center, alpha_max).0;
            if median(list, &seen, error).1 {
                picks[2 * i..][..2].fill(f64::INFINITY);
            }
        });
        Tolerances { picks: Tolerance::Each(picks) }
    }
}
