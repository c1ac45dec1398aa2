//! The fall-off of a lens: photographs whose corners are darker than their middle, by points that views show at
//! different distances from it.
//!
//! ```text
//! log2 brightness(p, v) = albedo_p + exposure_v - k1 u - k2 u^2,   u = 1 - cos(angle off the axis)
//! ```
//!
//! Robust least squares, as for a lamp, but k2 may be negative: the light of a wide aperture falls fastest halfway.

use rayon::prelude::*;
use serde::Serialize;

use super::fit::LampObservations;

/// The light at the corners, as a share of the middle's, from which the fall-off is that of a dark corner: good lenses
/// and cameras that correct theirs have more.
const MAX_CORNER: f64 = 0.6;
/// The largest standard error of the corner's light, stops.
const MAX_ERROR: f64 = 0.15;
/// The outermost points are at least at this part of the corner's u, and this share of all is beyond them.
const MIN_REACH: f64 = 0.6;
const OUTERMOST: f64 = 0.02;
/// Groups of points, each of which is left out once.
const FOLDS: usize = 5;

/// The light away from the middle of a photograph, relative to the middle's: exp(-falloff\[0\] u - falloff\[1\] u^2)
/// with u = 1 - cos of the angle off the camera's axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FalloffDiagnosis {
    /// The coefficients of u and its square.
    pub falloff: [f64; 2],
    /// The light at the farthest corner.
    pub corner: f64,
    /// Its standard error, stops; that of dark corners alone is measured, others have 0.
    pub error: f64,
    /// Whether points are seen far enough off the axis, and the light falls all the way.
    pub is_reached: bool,
    /// Whether the photographs were loaded without it.
    pub is_corrected: bool,
}

impl FalloffDiagnosis {
    /// Measures observations; `corner` is u at the corner that is farthest from the axis.
    pub(super) fn new(rows: &LampObservations, corner: f64) -> Self {
        let stops = |[first, second]: [f64; 2]| first * corner + second * corner * corner;
        let falloff = rows.fit_falloff();
        let measured = if (-stops(falloff)).exp2() < MAX_CORNER { FOLDS } else { 0 };
        let without = |fold: usize| stops(rows.part(|group| group % FOLDS != fold).fit_falloff());
        let folds: Vec<f64> = (0..measured).into_par_iter().map(without).collect();
        let mean = folds.iter().sum::<f64>() / folds.len().max(1) as f64;
        let squares = folds.iter().map(|fold| (fold - mean).powi(2)).sum::<f64>();
        Self {
            falloff: falloff.map(|stops| stops * std::f64::consts::LN_2),
            corner: (-stops(falloff)).exp2(),
            // The jackknife's.
            error: (squares * (FOLDS - 1) as f64 / FOLDS as f64).sqrt(),
            is_reached: rows.outermost(OUTERMOST) >= MIN_REACH * corner
                && falloff[0] >= 0.0
                && falloff[0] + 2.0 * falloff[1] * corner >= 0.0,
            is_corrected: false,
        }
    }

    /// Whether the corners are dark, and it is known how dark.
    pub fn is_found(&self) -> bool {
        self.corner < MAX_CORNER && self.error <= MAX_ERROR && self.is_reached
    }

    /// The measurement in a line.
    pub fn why(&self) -> String {
        let Self { corner, error, is_reached, .. } = self;
        let reach = if *is_reached { "" } else { ", extrapolated" };
        let error = match *error {
            0.0 => String::new(),
            stops => format!(", give or take {stops:.2} stops"),
        };
        format!(
            "the corners of the photographs have {corner:.2} of the light of the middle{error}{reach} (threshold \
             {MAX_CORNER})"
        )
    }
}
