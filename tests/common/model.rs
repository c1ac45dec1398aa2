//! The rounding model of the blending kernels.

use glam::UVec2;
use nightsplat::kernels::splat::{ALPHA_MIN, TRANSMITTANCE_MIN};
use nightsplat::reference::splat::{Fragment, Splat, fragments};

use super::{Frame, Setup};

/// Half a unit in the last place of 1.0: the relative error of one rounding.
pub(crate) const ROUNDING: f64 = f32::EPSILON as f64 / 2.0;

/// One pixel as f64 sees it, and what f32 may make of it.
pub(crate) struct PixelModel {
    /// Its place in a plane.
    pub(crate) at: usize,
    /// Front to back.
    pub(crate) fragments: Vec<Fragment>,
    /// The bound of the relative error of each fragment's alpha.
    pub(crate) alpha_errors: Vec<f64>,
    /// The bound of a channel's absolute error.
    pub(crate) error: f64,
    /// A rounding decides whether a splat is blended, capped, or the last.
    pub(crate) is_fragile: bool,
}

/// The rounding model of the blending kernels, for the pixels of a tile and the splats and colours of its list.
///
/// sigma is a sum whose terms round a few times each; exp adds 3 + 2 sigma units (the Vulkan specification's bound);
/// an alpha moves the pixel by at most 2 max|c| T. Products and sums over the list add a rounding per splat.
pub(crate) fn model_tile(setup: &Setup, frame: &Frame, tile: usize) -> Vec<PixelModel> {
    let (splats, colors) = tile_list(setup, frame, tile);
    let colors =
        colors.iter().chain(&setup.background.map(f64::from)).fold(1.0, |a: f64, c| a.max(c.abs()));
    let columns = setup.tiles().x;
    let first = UVec2::new(tile as u32 % columns, tile as u32 / columns) * setup.tile;
    let end = (first + setup.tile).min(setup.params.camera.size);
    let pixels = (first.y..end.y).flat_map(|y| (first.x..end.x).map(move |x| UVec2::new(x, y)));
    pixels.map(|pixel| model_pixel(setup, &splats, colors, pixel)).collect()
}

fn model_pixel(setup: &Setup, splats: &[Splat], max_color: f64, pixel: UVec2) -> PixelModel {
    let center = pixel.as_dvec2() + 0.5;
    let alpha_max = f64::from(setup.alpha_max);
    let sigma_error = |splat: &Splat| {
        let (d, conic) = (splat.mean2d - center, splat.conic);
        let terms = 0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) + (conic.y * d.x * d.y).abs();
        // d itself is rounded once from the mean and twice enters each term.
        6.0 * ROUNDING * terms
    };
    let alpha_error = |splat: &Splat| {
        sigma_error(splat) + 2.0 * ROUNDING * (4.0 + 2.0 * splat.sigma(splat.mean2d - center).abs())
    };
    let (fragments, _) = fragments(splats, center, alpha_max);
    let alpha_errors: Vec<f64> = fragments.iter().map(|f| alpha_error(&splats[f.index])).collect();
    let relative = |f: &Fragment, error: f64| f.alpha * error / (1.0 - f.alpha) + 2.0 * ROUNDING;
    let transmittance_error: f64 =
        fragments.iter().zip(&alpha_errors).map(|(f, &e)| relative(f, e)).sum();
    let moved: f64 = fragments.iter().zip(&alpha_errors).map(|(f, e)| f.alpha * f.before * e).sum();
    let error = max_color * (2.0 * moved + 4.0 * ROUNDING * (1.0 + fragments.len() as f64));
    let last = fragments.last().map_or(1.0, |f| f.before * (1.0 - f.alpha));
    let near = |value: f64, limit: f64, error: f64| (value / limit - 1.0).abs() < 2.0 * error;
    let is_fragile = splats.iter().any(|splat| {
        let sigma = splat.sigma(splat.mean2d - center);
        let (alpha, error) = (splat.opacity * (-sigma).exp(), alpha_error(splat));
        let after = last * (1.0 - alpha.min(alpha_max));
        let after_error = transmittance_error + alpha * error / (1.0 - alpha.min(alpha_max));
        near(alpha, ALPHA_MIN, error)
            || near(alpha, alpha_max, error)
            || sigma.abs() < sigma_error(splat)
            || near(after, TRANSMITTANCE_MIN, after_error)
            || near(last, TRANSMITTANCE_MIN, transmittance_error)
    });
    let at = (pixel.y * setup.params.camera.size.x + pixel.x) as usize;
    PixelModel { at, fragments, alpha_errors, error, is_fragile }
}

/// The splats of a tile's list, front to back, and their colours.
pub(crate) fn tile_list(setup: &Setup, frame: &Frame, tile: usize) -> (Vec<Splat>, Vec<f64>) {
    let range = frame.tile_ranges[tile];
    let slots = &frame.sorted_slots[range.x as usize..range.y as usize];
    let ids = || slots.iter().map(|&slot| frame.owners[slot as usize] as usize);
    let channels = setup.channels as usize;
    let colors = ids().flat_map(|id| &frame.colors[channels * id..][..channels]);
    (ids().map(|id| Splat::from(&frame.splats[id])).collect(), colors.map(|&c| c.into()).collect())
}
