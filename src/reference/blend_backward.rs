//! The gradients of one pixel with respect to its splats, in f64.

use glam::{DVec2, UVec2};

use super::blend_forward::{TileList, tile_pixels};
use super::blending::PixelModel;
use super::rounding::{UNIT, chain};
use super::splat::{Splat, fragments, stored_record};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::blend_backward::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::splat::RECORD_HEAD;

/// Adds what one pixel with the values `render` and the gradient `d_render` contributes to `gradient_records` (splats,
/// record): the moments and magnitudes of dL/dsigma, from the channels that `shapes` selects, and the gradients of the
/// colours.
#[expect(clippy::too_many_arguments, reason = "a pixel, its splats and its gradients")]
pub fn blend_pixel_backward(
    splats: &[Splat],
    colors: &[f64],
    render: &[f64],
    d_render: &[f64],
    pixel: DVec2,
    alpha_max: f64,
    shapes: impl Fn(usize) -> bool,
    gradient_records: &mut [f64],
) {
    let (channels, head) = (render.len(), RECORD_HEAD as usize);
    let mut light = render.to_vec();
    for fragment in fragments(splats, pixel, alpha_max).0 {
        let opacity = splats[fragment.index].opacity;
        let record = &mut gradient_records[(head + channels) * fragment.index..][..head + channels];
        let weight = fragment.alpha * fragment.before;
        let mut d_alpha = 0.0;
        for c in 0..channels {
            let color = colors[channels * fragment.index + c];
            record[head + c] += weight * d_render[c];
            if shapes(c) {
                d_alpha += (fragment.before * color - light[c]) * d_render[c];
            }
            light[c] -= weight * color;
        }
        d_alpha /= 1.0 - fragment.alpha;
        if opacity * fragment.falloff <= alpha_max {
            add_moments(record, -fragment.alpha * d_alpha, fragment.d);
        }
    }
}

/// Whether a channel moves and shapes the splats.
fn shapes(constants: &Constants, channel: usize) -> bool {
    let Constants { channels, shaping_channels, view_depths, .. } = *constants;
    let is_shaping = channel < shaping_channels as usize;
    shaping_channels > 0 && (is_shaping || channel >= (channels - view_depths) as usize)
}

/// A pixel of a tile: its centre, its render, and the gradient of that.
struct Pixel {
    center: DVec2,
    render: Vec<f64>,
    d_render: Vec<f64>,
}

/// Adds the moments of dL/dsigma at an offset from the mean, in the order of a gradient record: 1, x, y, xx, xy, yy,
/// and the magnitude.
fn add_moments(record: &mut [f64], d_sigma: f64, DVec2 { x, y }: DVec2) {
    let powers = [1.0, x, y, x * x, x * y, y * y, d_sigma.signum()];
    record.iter_mut().zip(powers).for_each(|(sum, power)| *sum += d_sigma * power);
}

/// Sums the contributions of all pixels to the records of their tile's list, and writes each record to its
/// intersection.
fn for_each_tile(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
    mut write: impl FnMut(usize, f64),
    visit: impl Fn(&TileList, &Pixel, &mut [f64]),
) {
    let Slices {
        tile_ranges,
        sorted_intersections,
        gaussian_ids,
        splats,
        colors,
        render,
        d_render,
        ..
    } = slices;
    let (channels, pixels) = (constants.channels as usize, params.size.element_product() as usize);
    let record = RECORD_HEAD as usize + channels;
    let tile = UVec2::new(constants.tile_width, constants.tile_height);
    for index in 0..params.tile_columns * params.size.y.div_ceil(tile.y) {
        let range = tile_ranges[index as usize];
        let intersection_ids = &sorted_intersections[range.x as usize..range.y as usize];
        let list =
            TileList::new(constants.channels, intersection_ids, gaussian_ids, splats, colors);
        let mut sums = vec![0.0; record * list.intersection_ids.len()];
        for pixel in tile_pixels(index, params.tile_columns, tile, params.size) {
            let at = (pixel.y * params.size.x + pixel.x) as usize;
            let values =
                |image: &[f32]| (0..channels).map(|c| image[c * pixels + at].into()).collect();
            let (render, d_render) = (values(render), values(d_render));
            visit(&list, &Pixel { center: pixel.as_dvec2() + 0.5, render, d_render }, &mut sums);
        }
        let stored = stored_record(constants.channels);
        for (sums, &slot) in sums.chunks(record).zip(&list.intersection_ids) {
            let padded = sums.iter().copied().chain(std::iter::repeat(0.0));
            (stored * slot as usize..)
                .zip(padded.take(stored))
                .for_each(|(at, sum)| write(at, sum));
        }
    }
}

/// Adds to `bounds` the error bound of one pixel's contribution to the records. The remaining light has the error of
/// the render, magnified by 1 / (1 - alpha); the rest is relative to the magnitude of the contribution, which counts in
/// full if a rounding decides whether it exists.
fn add_bounds(constants: &Constants, list: &TileList, pixel: &Pixel, bounds: &mut [f64]) {
    let (channels, tile) =
        (constants.channels as usize, UVec2::new(constants.tile_width, constants.tile_height));
    let model = PixelModel::new(&list.splats, pixel.center, constants.alpha_max.into(), tile);
    let d = |c: usize| pixel.d_render[c].abs();
    let shaping = || (0..channels).filter(|&c| shapes(constants, c));
    let d_sum: f64 = shaping().map(d).sum();
    let light: f64 = shaping().map(|c| pixel.render[c].abs() * d(c)).sum();
    let light_error = model.error * list.largest_color(&pixel.render) * d_sum;
    // At the start of a segment, the colour before it has the error of a render, too.
    let renders = if constants.segment == 0 { 2.0 } else { 3.0 };
    let head = RECORD_HEAD as usize;
    // Every sum is over the pixels of the tile.
    let summed = (chain(tile.element_product() as usize) + 64.0) * UNIT;
    for &(fragment, alpha_error) in &model.fragments {
        let bound = &mut bounds[(head + channels) * fragment.index..][..head + channels];
        let color = &list.colors[channels * fragment.index..][..channels];
        let share: f64 = shaping().map(|c| fragment.before * color[c].abs() * d(c)).sum();
        let rounded = 2.0 * alpha_error / (1.0 - fragment.alpha) + summed;
        let relative = if model.is_fragile { 1.0 } else { rounded };
        let d_alpha = (renders * light_error + relative * (light + share)) / (1.0 - fragment.alpha);
        let d_sigma = fragment.alpha * d_alpha;
        // An offset has the rounding error of a tile's extent.
        let offset = fragment.d.abs() + 1.0;
        add_moments(bound, d_sigma, offset);
        let weight = fragment.alpha * fragment.before;
        (0..channels).for_each(|c| bound[head + c] += weight * (relative + model.error) * d(c));
    }
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, mut slices: Slices<'_>) {
        let alpha_max = constants.alpha_max.into();
        let gradient_records = std::mem::take(&mut slices.gradient_records);
        let write = |at: usize, sum: f64| gradient_records[at] = sum as f32;
        for_each_tile(params, constants, &slices, write, |list, pixel, sums| {
            let Pixel { center, render, d_render } = pixel;
            blend_pixel_backward(
                &list.splats,
                &list.colors,
                render,
                d_render,
                *center,
                alpha_max,
                |c| shapes(constants, c),
                sums,
            );
        });
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let mut bounds = vec![0.0; slices.gradient_records.len()];
        let write = |at: usize, bound: f64| bounds[at] = bound;
        for_each_tile(params, constants, &slices, write, |list, pixel, bounds| {
            add_bounds(constants, list, pixel, bounds);
        });
        Tolerances { gradient_records: Tolerance::Each(bounds) }
    }
}
