//! The light of one pixel, in f64, by going through everything in its tile.

use glam::{DVec2, UVec2};

use super::splat::{Splat, fragments};
use crate::gpu::Reference;
use crate::kernels::blend_forward::{Constants, Kernel, Params, Slices};

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

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let Slices { tile_ranges, sorted_slots, owners, splats, colors, render, transmittances } =
            slices;
        let channels = constants.channels as usize;
        let background: Vec<f64> =
            params.background[..channels].iter().copied().map(f64::from).collect();
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
            for pixel in tile_pixels(index as u32, params.tile_columns, tile, params.size) {
                let center = pixel.as_dvec2() + 0.5;
                let (values, transmittance) = blend_pixel(
                    &list,
                    &list_colors,
                    &background,
                    center,
                    constants.alpha_max.into(),
                );
                let at = pixel.y as usize * width + pixel.x as usize;
                transmittances[at] = transmittance as f32;
                for c in 0..channels {
                    render[c * width * height + at] = values[c] as f32;
                }
            }
        }
    }
}

/// The pixels of a tile that lie in the image, row by row.
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
