//! The gradients that one pixel leaves on its splats, in f64.

use glam::{DVec2, UVec2};

use super::blend_forward::tile_pixels;
use super::splat::{Splat, fragments};
use crate::gpu::Reference;
use crate::kernels::blend_backward::{Constants, Kernel, Params, Slices};
use crate::kernels::splat::RECORD_HEAD;

/// Adds to `records` (splats, record) what one pixel with the values `render` and the gradient `d_render` says:
/// the gradients of mean2d, conic, opacity and colours.
pub fn blend_pixel_backward(
    splats: &[Splat],
    colors: &[f64],
    render: &[f64],
    d_render: &[f64],
    pixel: DVec2,
    alpha_max: f64,
    records: &mut [f64],
) {
    let (channels, head) = (render.len(), RECORD_HEAD as usize);
    let mut light = render.to_vec();
    for fragment in fragments(splats, pixel, alpha_max).0 {
        let Splat { conic, opacity, .. } = splats[fragment.index];
        let record = &mut records[(head + channels) * fragment.index..][..head + channels];
        let weight = fragment.alpha * fragment.before;
        let mut d_alpha = 0.0;
        for c in 0..channels {
            let color = colors[channels * fragment.index + c];
            record[head + c] += weight * d_render[c];
            d_alpha += (fragment.before * color - light[c]) * d_render[c];
            light[c] -= weight * color;
        }
        d_alpha /= 1.0 - fragment.alpha;
        if opacity * fragment.falloff <= alpha_max {
            let d = fragment.d;
            let d_sigma = -fragment.alpha * d_alpha;
            record[0] += d_sigma * (conic.x * d.x + conic.y * d.y);
            record[1] += d_sigma * (conic.y * d.x + conic.z * d.y);
            record[2] += d_sigma * 0.5 * d.x * d.x;
            record[3] += d_sigma * d.x * d.y;
            record[4] += d_sigma * 0.5 * d.y * d.y;
            record[5] += fragment.falloff * d_alpha;
        }
    }
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { tile_ranges, sorted_slots, owners, splats, colors, render, d_render, records } =
            slices;
        let channels = constants.channels as usize;
        let record = RECORD_HEAD as usize + channels;
        let [width, height] = params.size.as_usizevec2().to_array();
        let tile = UVec2::new(constants.tile_width, constants.tile_height);
        for (index, range) in tile_ranges.iter().enumerate() {
            let slots = &sorted_slots[range.x as usize..range.y as usize];
            let ids = || slots.iter().map(|&slot| owners[slot as usize] as usize);
            let list: Vec<Splat> = ids().map(|id| Splat::from(&splats[id])).collect();
            let list_colors: Vec<f64> = ids()
                .flat_map(|id| &colors[channels * id..][..channels])
                .map(|&c| c.into())
                .collect();
            let mut sums = vec![0.0; record * list.len()];
            for pixel in tile_pixels(index as u32, params.tile_columns, tile, params.size) {
                let at = pixel.y as usize * width + pixel.x as usize;
                let values = |image: &[f32]| -> Vec<f64> {
                    (0..channels).map(|c| image[c * width * height + at].into()).collect()
                };
                blend_pixel_backward(
                    &list,
                    &list_colors,
                    &values(render),
                    &values(d_render),
                    pixel.as_dvec2() + 0.5,
                    constants.alpha_max.into(),
                    &mut sums,
                );
            }
            for (j, &slot) in slots.iter().enumerate() {
                for k in 0..record {
                    records[record * slot as usize + k] = sums[record * j + k] as f32;
                }
            }
        }
    }
}
