//! A projected splat: its tiles and pixels in f32 as in `include/splat.glsl`, and its alpha in f64.

use glam::{DVec2, DVec3, UVec2};

use super::rounding::UNIT;
use crate::kernels::ProjectedSplat;
use crate::kernels::splat::{ALPHA_MIN, RECORD_HEAD, TRANSMITTANCE_MIN};

/// Floats of a gradient record as stored: in vectors of four, padded with zeros.
pub(super) fn stored_record(channels: u32) -> usize {
    (RECORD_HEAD + channels).next_multiple_of(4) as usize
}

/// Floats of a splat's values as stored: in vectors of four, padded with zeros.
pub(super) fn stored_color(channels: u32) -> usize {
    channels.next_multiple_of(4) as usize
}

/// The part of a [`ProjectedSplat`] that determines its alpha.
#[derive(Clone, Copy, Debug)]
pub struct Splat {
    /// Pixels.
    pub mean2d: DVec2,
    /// Upper triangle (xx, xy, yy) of the inverse cov2d, 1 / pixels^2.
    pub conic: DVec3,
    /// After the sigmoid.
    pub opacity: f64,
}

impl From<&ProjectedSplat> for Splat {
    fn from(splat: &ProjectedSplat) -> Self {
        Self {
            mean2d: splat.mean2d.as_dvec2(),
            conic: splat.conic.as_dvec3(),
            opacity: splat.opacity.into(),
        }
    }
}

impl Splat {
    /// Exponent of the Gaussian at the offset `d` from its mean, sign reversed: alpha = opacity exp(-sigma).
    pub fn sigma(&self, d: DVec2) -> f64 {
        let conic = self.conic;
        0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) + conic.y * d.x * d.y
    }
}

/// A splat's contribution to one pixel.
#[derive(Clone, Copy, Debug)]
pub struct Fragment {
    /// The splat's index in the list.
    pub index: usize,
    /// From the pixel's centre to the splat's mean, pixels.
    pub d: DVec2,
    /// exp(-sigma).
    pub falloff: f64,
    /// After the cap.
    pub alpha: f64,
    /// The transmittance in front of it.
    pub before: f64,
}

/// The fragments of `splats`, front to back, at a pixel's centre, and the transmittance after them.
pub fn fragments(splats: &[Splat], pixel: DVec2, alpha_max: f64) -> (Vec<Fragment>, f64) {
    let (fragments, transmittance, _) = blended(splats, pixel, alpha_max);
    (fragments, transmittance)
}

/// Whether one of `splats` is the one before which the pixel ends.
pub(super) fn is_done(splats: &[Splat], pixel: DVec2, alpha_max: f64) -> bool {
    blended(splats, pixel, alpha_max).2
}

fn blended(splats: &[Splat], pixel: DVec2, alpha_max: f64) -> (Vec<Fragment>, f64, bool) {
    let mut fragments = vec![];
    let mut before = 1.0;
    for (index, splat) in splats.iter().enumerate() {
        let d = splat.mean2d - pixel;
        let sigma = splat.sigma(d);
        let falloff = (-sigma).exp();
        let alpha = alpha_max.min(splat.opacity * falloff);
        if !(sigma >= 0.0 && alpha >= ALPHA_MIN) {
            continue;
        }
        let after = before * (1.0 - alpha);
        if after < TRANSMITTANCE_MIN {
            return (fragments, before, true);
        }
        fragments.push(Fragment { index, d, falloff, alpha, before });
        before = after;
    }
    (fragments, before, false)
}

/// The relative error of an ellipse's extent: of the square root of [`splat_level`], whose logarithm is good to 2^-21
/// where it is small, and of the quotients and roots around it.
pub(super) fn extent_error(opacity: f32) -> f64 {
    48.0 * UNIT + 1.1 / 2_097_152.0 / f64::from(splat_level(opacity))
}

/// Twice the sigma at which alpha falls to 1/255, slightly too large.
pub fn splat_level(opacity: f32) -> f32 {
    2.002 * (255.0 * opacity).ln() + 1e-3
}

/// The columns of pixels [first, last] whose centres are in the ellipse somewhere between the pixel rows `top` and
/// `bottom`; empty if last < first.
pub fn splat_columns(splat: &ProjectedSplat, top: f32, bottom: f32) -> [i32; 2] {
    let ProjectedSplat { mean2d, conic, opacity, half_extent: extent } = *splat;
    let y0 = top + 0.5 - mean2d.y;
    let y1 = bottom + 0.5 - mean2d.y;
    if !(y0 <= extent.y && y1 >= -extent.y) {
        return [1, 0];
    }
    let shear = -conic.y / conic.x;
    let rightmost = -conic.y / conic.z * extent.x;
    let y_right = rightmost.clamp(y0, y1);
    let y_left = (-rightmost).clamp(y0, y1);
    let width = (splat_level(opacity) / conic.x).sqrt();
    let right = y_right / extent.y;
    let left = y_left / extent.y;
    let right = mean2d.x + shear * y_right + width * (1.0 - right * right).max(0.0).sqrt() + 0.01;
    let left = mean2d.x + shear * y_left - width * (1.0 - left * left).max(0.0).sqrt() - 0.01;
    let left = left.clamp(-1e6, 1e6);
    let right = right.clamp(-1e6, 1e6);
    [(left - 0.5).ceil() as i32, (right - 0.5).floor() as i32]
}

/// The tile columns [x, y) that the splat intersects in a row of tiles of an image `width` pixels wide.
pub fn splat_tiles(splat: &ProjectedSplat, tile_row: u32, width: u32, tile: UVec2) -> [u32; 2] {
    let top = (tile_row * tile.y) as f32;
    let [first, last] = splat_columns(splat, top, top + (tile.y - 1) as f32);
    let (first, last) = (first.max(0), last.min(width as i32 - 1));
    if last < first {
        return [0, 0];
    }
    [first as u32 / tile.x, last as u32 / tile.x + 1]
}

/// The rows of tiles [x, y) that the splat's box intersects in an image `height` pixels high.
pub fn splat_tile_rows(splat: &ProjectedSplat, height: u32, tile: UVec2) -> [u32; 2] {
    let top = (splat.mean2d.y - splat.half_extent.y).clamp(0.0, height as f32);
    let bottom = (splat.mean2d.y + splat.half_extent.y).clamp(0.0, height as f32);
    [top as u32 / tile.y, (bottom.ceil() as u32).div_ceil(tile.y)]
}
