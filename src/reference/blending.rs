//! The rounding model of the blending kernels: the error of one pixel in single precision.
//!
//! The exponent of alpha to base 2 is a sum that begins with the logarithm of the opacity, and whose terms round a few
//! times each; exp2 adds 3 + 2 |exponent| units in the last place; an alpha changes the pixel by at most 2 max|c| T.
//! Products and sums over the list add a rounding per splat. If a rounding decides whether a splat is blended, capped
//! or the last, either outcome is accepted: the difference is part of the bound.

use glam::{DVec2, UVec2};

use super::rounding::UNIT;
use super::splat::{Fragment, Splat};
use crate::kernels::splat::{ALPHA_MIN, TRANSMITTANCE_MIN};

/// One pixel, and the allowed error of a device.
pub(super) struct PixelModel {
    /// All splats that the device may blend, front to back, with the bound of each alpha's relative error.
    pub(super) fragments: Vec<(Fragment, f64)>,
    /// The bound of a channel's error, over the largest magnitude of a colour; also that of the transmittance.
    pub(super) error: f64,
    /// Whether a rounding decides about a splat.
    pub(super) is_fragile: bool,
}

impl PixelModel {
    pub(super) fn new(splats: &[Splat], pixel: DVec2, alpha_max: f64, tile: UVec2) -> Self {
        let mut model = Self { fragments: vec![], error: 0.0, is_fragile: false };
        let near = |value: f64, limit: f64, error: f64| (value / limit - 1.0).abs() <= 2.0 * error;
        let (mut before, mut before_error) = (1.0, 0.0);
        let mut is_done = false;
        for (index, splat) in splats.iter().enumerate() {
            let d = splat.mean2d - pixel;
            let sigma = splat.sigma(d);
            let (falloff, sigma_error) = ((-sigma).exp(), sigma_error(splat, d, tile));
            let exponent = (sigma - splat.opacity.ln()).abs() * std::f64::consts::LOG2_E;
            let error =
                sigma_error + logarithm_error(splat.opacity) + 2.0 * UNIT * (3.0 + 2.0 * exponent);
            let free_alpha = splat.opacity * falloff;
            let alpha = free_alpha.min(alpha_max);
            let may_count = near(alpha, ALPHA_MIN, error) || sigma.abs() <= sigma_error;
            let counts = sigma >= 0.0 && alpha >= ALPHA_MIN;
            if !counts && !may_count {
                continue;
            }
            let after = before * (1.0 - alpha);
            // A device may round the product and the difference of T - alpha T.
            let after_error = before_error + (alpha * error + 2.0 * UNIT) / (1.0 - alpha);
            let may_end = near(after, TRANSMITTANCE_MIN, after_error);
            let ends = counts && after < TRANSMITTANCE_MIN;
            if ends && !may_count && !may_end {
                break;
            }
            model.fragments.push((Fragment { index, d, falloff, alpha, before }, error));
            model.is_fragile |= may_count || may_end || near(free_alpha, alpha_max, error);
            is_done |= ends;
            if may_end || ends {
                model.error += 2.0 * before;
            } else if may_count {
                model.error += 2.0 * before * alpha;
            }
            if counts && !is_done {
                model.error += 2.0 * alpha * before * error;
                (before, before_error) = (after, after_error);
            }
        }
        model.error += before * before_error + 4.0 * UNIT * (1.0 + model.fragments.len() as f64);
        model
    }
}

/// The error of the difference between the exponents at the offset `d` and at the mean, to base e. An offset is rounded
/// at the tile's corner and at the pixel; a term rounds at most six times, twice of these as a coefficient to base 2,
/// and twice more where it is added to the logarithm of the opacity, which rounds there itself.
fn sigma_error(splat: &Splat, d: DVec2, tile: UVec2) -> f64 {
    let conic = splat.conic;
    let terms = 0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) + (conic.y * d.x * d.y).abs();
    let off = UNIT * (d.abs() + tile.as_dvec2());
    let slope = DVec2::new(
        conic.x * d.x.abs() + conic.y.abs() * d.y.abs(),
        conic.z * d.y.abs() + conic.y.abs() * d.x.abs(),
    );
    8.0 * UNIT * terms + 2.0 * UNIT * splat.opacity.ln().abs() + slope.dot(off)
}

/// The error of the device's logarithm of an opacity, to base e: 2^-21 of that to base 2 where the opacity is at least
/// 1/2, else 3 units in the last place.
fn logarithm_error(opacity: f64) -> f64 {
    let near_one = std::f64::consts::LN_2 / 2_097_152.0;
    if opacity >= 0.5 { near_one } else { 6.0 * UNIT * opacity.ln().abs() }
}
