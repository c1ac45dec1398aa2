//! The colour of one pixel, in f64, over all splats of its tile.

use glam::{DVec2, UVec2};

use super::blending::PixelModel;
use super::splat::{Fragment, Splat, fragments, is_done, stored_color};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::ProjectedSplat;
use crate::kernels::blend_forward::{
    Constants, DEPTH_MEAN, DEPTH_MEDIAN, Kernel, NO_DEPTH, Params, Slices, Tolerances,
};
use crate::kernels::status::STATUS_TILE_LIMIT;

/// One pixel's channels and transmittance, from splats front to back with colours (splats, channels).
pub fn blend_pixel(
    splats: &[Splat],
    colors: &[f64],
    background: &[f64],
    pixel: DVec2,
    alpha_max: f64,
) -> (Vec<f64>, f64) {
    let channels = background.len();
    let (fragments, transmittance) = fragments(splats, pixel, alpha_max);
    let mut render: Vec<f64> = background.iter().map(|c| transmittance * c).collect();
    for fragment in fragments {
        for c in 0..channels {
            let color = colors[channels * fragment.index + c];
            render[c] += fragment.alpha * fragment.before * color;
        }
    }
    (render, transmittance)
}

/// The splats of a tile, front to back.
pub(super) struct TileList {
    pub(super) intersection_ids: Vec<u32>,
    pub(super) splats: Vec<Splat>,
    /// (splats, channels)
    pub(super) colors: Vec<f64>,
}

impl TileList {
    pub(super) fn new(
        channels: u32,
        intersection_ids: &[u32],
        gaussian_ids: &[u32],
        splats: &[ProjectedSplat],
        colors: &[f32],
    ) -> Self {
        let (channels, ids) = (channels as usize, || {
            intersection_ids.iter().map(|&slot| gaussian_ids[slot as usize] as usize)
        });
        let stored = stored_color(channels as u32);
        let color = |id| colors[stored * id..][..channels].iter().map(|&c| f64::from(c));
        Self {
            intersection_ids: intersection_ids.to_vec(),
            splats: ids().map(|id| Splat::from(&splats[id])).collect(),
            colors: ids().flat_map(color).collect(),
        }
    }

    /// The last channel of a splat, which is its depth in the view.
    pub(super) fn depth(&self, index: usize) -> f64 {
        let channels = self.colors.len() / self.splats.len();
        self.colors[channels * index + channels - 1]
    }

    /// The largest magnitude of a colour, at least 1.
    pub(super) fn largest_color(&self, background: &[f64]) -> f64 {
        self.colors.iter().chain(background).fold(1.0, |largest: f64, c| largest.max(c.abs()))
    }
}

/// Offset and length of every tile's run among the sorted intersections.
fn tile_runs(params: &Params, constants: &Constants, slices: &Slices<'_>) -> Vec<(UVec2, u32)> {
    let mut first = 0;
    let tiles = 0..params.tile_columns * params.size.y.div_ceil(constants.tile_height);
    let run = |tile| {
        let rest = &slices.sorted_tiles[first..slices.counts[0] as usize];
        let count = rest.iter().take_while(|&&other| other == tile).count();
        let run = UVec2::new(first as u32, (first + count) as u32);
        first += count;
        (run, count as u32)
    };
    tiles.map(run).collect()
}

/// Calls `visit` with the number of every tile of the image and its list.
fn for_each_tile(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
    mut visit: impl FnMut(u32, &TileList),
) {
    let Slices { sorted_intersections, gaussian_ids, splats, colors, .. } = slices;
    for (index, (range, count)) in (0..).zip(tile_runs(params, constants, slices)) {
        let shown = if count > params.longest_run { 0 } else { count };
        let intersection_ids = &sorted_intersections[range.x as usize..][..shown as usize];
        let list =
            TileList::new(constants.channels, intersection_ids, gaussian_ids, splats, colors);
        visit(index, &list);
    }
}

/// Calls `visit` for every pixel: the list of its tile, the splats that are seen, its centre and its index.
fn for_each_pixel(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
    mut visit: impl FnMut(&TileList, &[Splat], DVec2, usize),
) {
    let tile = UVec2::new(constants.tile_width, constants.tile_height);
    for_each_tile(params, constants, slices, |index, list| {
        for pixel in tile_pixels(index, params.tile_columns, tile, params.size) {
            let at = (pixel.y * params.size.x + pixel.x) as usize;
            let seen = seen(params, constants, slices.limits, list, at);
            visit(list, &list.splats[..seen], pixel.as_dvec2() + 0.5, at);
        }
    });
}

/// The splats of a list that are seen at pixel `at`: with depths, those before the first beyond its limit.
fn seen(
    params: &Params,
    constants: &Constants,
    limits: &[f32],
    list: &TileList,
    at: usize,
) -> usize {
    let all = list.splats.len();
    if constants.view_depths == 0 {
        return all;
    }
    let limit = if params.has_limits != 0 { f64::from(limits[at]) } else { NO_DEPTH };
    (0..all).take_while(|&i| list.depth(i) <= limit || limit.is_nan()).count()
}

/// Whether the last channel is a depth of this kind, `DEPTH_*`.
fn keeps(kind: u32, params: &Params, constants: &Constants) -> bool {
    constants.view_depths != 0 && params.depth_kind == kind
}

/// The sum of the weighted depths over alpha; 0 where nothing is visible.
pub fn mean_depth(sum: f64, transmittance: f64) -> f64 {
    if transmittance < 1.0 { sum / (1.0 - transmittance) } else { 0.0 }
}

/// The depth at which the transmittance passes 1/2, and whether a rounding of it decides.
pub(super) fn median(list: &TileList, fragments: &[Fragment], error: f64) -> (f64, bool) {
    let after = |fragment: &Fragment| fragment.before * (1.0 - fragment.alpha);
    let passing = fragments.iter().find(|&fragment| after(fragment) <= 0.5);
    let is_fragile = fragments.iter().any(|fragment| (after(fragment) - 0.5).abs() <= error);
    (passing.map_or(NO_DEPTH, |fragment| list.depth(fragment.index)), is_fragile)
}

/// The splats of a list before which segments start, except for the first, with the numbers of their states.
fn segment_starts(run: UVec2, count: u32, segment: u32) -> Vec<(usize, usize)> {
    let starts = (0..count).step_by(segment.max(1) as usize).skip(1);
    let state = |start: u32| (start as usize, ((run.x + start) / segment) as usize);
    if segment == 0 { vec![] } else { starts.map(state).collect() }
}

/// Visits the state of every pixel of a tile before every segment: the list, the number of its splats before the
/// segment, the centre of the pixel, `None` outside the image, and the index of its transmittance; its channels follow
/// at a distance of a tile's pixels.
fn for_each_state(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
    mut visit: impl FnMut(&TileList, usize, Option<DVec2>, usize),
) {
    let tile = UVec2::new(constants.tile_width, constants.tile_height);
    let runs = tile_runs(params, constants, slices);
    for_each_tile(params, constants, slices, |index, list| {
        let (run, _) = runs[index as usize];
        let origin = UVec2::new(index % params.tile_columns, index / params.tile_columns) * tile;
        let starts = segment_starts(run, list.splats.len() as u32, constants.segment);
        let pixels = tile.element_product() as usize;
        for (start, block) in starts {
            for at in 0..pixels {
                let pixel = origin + UVec2::new(at as u32 % tile.x, at as u32 / tile.x);
                let is_inside = pixel.cmplt(params.size).all();
                let center = is_inside.then(|| pixel.as_dvec2() + 0.5);
                visit(list, start, center, (constants.channels as usize + 1) * pixels * block + at);
            }
        }
    });
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, mut slices: Slices<'_>) {
        let background = background(params, constants);
        let pixels = params.size.element_product() as usize;
        for (tile, (run, count)) in tile_runs(params, constants, &slices).into_iter().enumerate() {
            slices.tile_ranges[tile] = run;
            if count > params.longest_run {
                slices.tile_ranges[tile].y = run.x;
                slices.status[0] |= STATUS_TILE_LIMIT;
                slices.status[2] = slices.status[2].max(count);
            }
        }
        let (alpha_max, stride) =
            (constants.alpha_max.into(), (constants.tile_width * constants.tile_height) as usize);
        let states = std::mem::take(&mut slices.segment_states);
        for_each_state(params, constants, &slices, |list, start, center, at| {
            let seen = &list.splats[..start];
            let black = vec![0.0; constants.channels as usize];
            let (values, transmittance) = match center {
                Some(center) => blend_pixel(seen, &list.colors, &black, center, alpha_max),
                None => (black, 0.0),
            };
            let is_done = center.is_none_or(|center| is_done(seen, center, alpha_max));
            states[at] = if is_done { 0.0 } else { transmittance as f32 };
            for (c, value) in (1..).zip(values) {
                states[at + c * stride] = value as f32;
            }
        });
        let (render, transmittances) =
            (std::mem::take(&mut slices.render), std::mem::take(&mut slices.transmittances));
        for_each_pixel(params, constants, &slices, |list, seen, center, at| {
            let (mut values, transmittance) =
                blend_pixel(seen, &list.colors, &background, center, alpha_max);
            let last = values.len() - 1;
            if keeps(DEPTH_MEAN, params, constants) {
                values[last] = mean_depth(values[last], transmittance);
            }
            if keeps(DEPTH_MEDIAN, params, constants) {
                values[last] = median(list, &fragments(seen, center, alpha_max).0, 0.0).0;
            }
            transmittances[at] = transmittance as f32;
            for (c, value) in values.into_iter().enumerate() {
                render[c * pixels + at] = value as f32;
            }
        });
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let background = background(params, constants);
        let pixels = params.size.element_product() as usize;
        let alpha_max = constants.alpha_max.into();
        let mut errors = vec![0.0; pixels];
        let mut largest_colors = vec![0.0; pixels];
        let mut medians = vec![0.0; pixels];
        let mut alphas = vec![0.0; pixels];
        let tile_size = UVec2::new(constants.tile_width, constants.tile_height);
        for_each_pixel(params, constants, &slices, |list, seen, center, at| {
            errors[at] = PixelModel::new(seen, center, alpha_max, tile_size).error;
            largest_colors[at] = list.largest_color(&background);
            let (fragments, transmittance) = fragments(seen, center, alpha_max);
            alphas[at] = 1.0 - transmittance;
            let (_, is_fragile) = median(list, &fragments, errors[at]);
            medians[at] = if is_fragile { f64::INFINITY } else { 0.0 };
        });
        let of_channel = errors.iter().zip(largest_colors).map(|(error, color)| error * color);
        let mut render: Vec<f64> =
            of_channel.cycle().take(constants.channels as usize * pixels).collect();
        let first = render.len() - pixels;
        if keeps(DEPTH_MEDIAN, params, constants) {
            render.splice(first.., medians);
        }
        if keeps(DEPTH_MEAN, params, constants) {
            for (bound, (error, alpha)) in render[first..].iter_mut().zip(errors.iter().zip(alphas))
            {
                let least = alpha - error;
                *bound = if least > 0.0 { 3.0 * *bound / least } else { f64::INFINITY };
            }
        }
        let stride = (constants.tile_width * constants.tile_height) as usize;
        let mut states = vec![0.0; slices.segment_states.len()];
        for_each_state(params, constants, &slices, |list, start, center, at| {
            let seen = &list.splats[..start];
            let model = center.map(|center| PixelModel::new(seen, center, alpha_max, tile_size));
            let is_done = center.is_none_or(|center| is_done(seen, center, alpha_max));
            states[at] = model.as_ref().map_or(0.0, |model| model.error);
            // Of a pixel that is done, or is by another rounding, the transmittance alone is defined.
            let is_defined = !is_done && model.is_none_or(|model| !model.is_fragile);
            let largest = list.largest_color(&[]);
            let of_channels = if is_defined { states[at] * largest } else { f64::INFINITY };
            (1..=constants.channels as usize).for_each(|c| states[at + c * stride] = of_channels);
        });
        Tolerances {
            render: Tolerance::Each(render),
            segment_states: Tolerance::Each(states),
            transmittances: Tolerance::Each(errors),
            ..Tolerances::default()
        }
    }
}

/// Of every channel.
fn background(params: &Params, constants: &Constants) -> Vec<f64> {
    let mut background = params.background.map(f64::from).to_vec();
    background.resize(constants.channels as usize, 0.0);
    background
}

/// The pixels of a tile that are inside the image, row by row.
pub(super) fn tile_pixels(
    index: u32,
    tile_columns: u32,
    tile: UVec2,
    size: UVec2,
) -> impl Iterator<Item = UVec2> {
    let first = UVec2::new(index % tile_columns, index / tile_columns) * tile;
    let end = (first + tile).min(size);
    (first.y..end.y).flat_map(move |y| (first.x..end.x).map(move |x| UVec2::new(x, y)))
}
