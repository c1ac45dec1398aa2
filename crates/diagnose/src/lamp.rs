//! A lamp that moves with the camera, found by the brightness of points: with distance and angle, by how much does a
//! point differ between its views?
//!
//! ```text
//! log2 brightness(p, v) = albedo_p + exposure_v - exponent log2 d - k1 u - k2 u^2,   u = 1 - cos(angle off the axis)
//! ```
//!
//! Robust least squares (Huber), albedos and exposures by conjugate gradients. What each cause explains is measured
//! on points that its coefficients were not fitted to, so that noise explains nothing. The albedo is the point's own:
//! light that does not move with the camera, such as a window's, explains nothing either.

use rayon::prelude::*;
use serde::Serialize;

pub(super) mod bands;
pub(super) mod falloff;
mod fit;

use self::bands::BandsDiagnosis;
use self::falloff::FalloffDiagnosis;
pub(super) use self::fit::LampObservations;
use self::fit::{ALL, ANGLE, LOG_LINEAR, NOTHING};
use super::geometry::deviation;

/// A lamp is learned if it explains at least this fraction of the variance that exposures leave.
const MIN_SHARE: f64 = 0.2;
/// And at least these stops, as a standard deviation.
const MIN_STOPS: f64 = 0.15;
/// And distance at least these stops of them: a vignette depends on the angle alone.
const MIN_DISTANCE_STOPS: f64 = 0.08;
/// The smallest exponent of a lamp.
const MIN_EXPONENT: f64 = 0.5;

/// Every point of a fold is predicted from those of the others.
const FOLDS: usize = 4;
/// This fraction of the residuals, the largest ones, does not count: edges, highlights and wrong points.
const TRIMMED: f64 = 0.05;

/// A lamp that moves with the camera, as the photographs' brightness at shared points shows it. Its light at a distance
/// d, relative to that on its axis at `d_ref`, is
///
/// ```text
/// ambient + (1 - ambient) (d_ref / d)^exponent exp(-falloff[0] u - falloff[1] u^2)
/// ```
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LampDiagnosis {
    /// Of the distance; 2 for a small lamp.
    pub exponent: f64,
    /// Of u = 1 - cos(angle off the camera's axis) and its square, at least 0.
    pub falloff: [f64; 2],
    /// The fraction of the light that does not fall off, 0 to 0.5.
    pub ambient: f64,
    /// The median distance of a point from the cameras that see it, world units.
    pub d_ref: f64,
    /// The fraction of the variance of a point's log brightness over its views that lamp and exposures explain
    /// together, on points that they were not fitted to; below 0 if they predict worse than nothing.
    pub r_squared: f64,
    /// The standard deviation that the lamp explains beyond exposures, stops.
    pub stops: f64,
    /// The fraction of the variance that exposures explain alone.
    pub exposure_r_squared: f64,
    /// The fraction of the variance that the lamp explains alone.
    pub lamp_r_squared: f64,
    /// The standard deviation of a point's brightness over its views, stops.
    pub spread: f64,
    /// The standard deviation that distance explains beyond exposures and angles, stops.
    pub distance_stops: f64,
    /// The standard deviation of the views' exposures beside the lamp, stops.
    pub exposure_spread: f64,
    /// The number of points that were measured.
    pub points: usize,
}

impl LampDiagnosis {
    /// The fraction of the variance left by exposures that the lamp explains.
    pub fn share(&self) -> f64 {
        (self.r_squared - self.exposure_r_squared) / (1.0 - self.exposure_r_squared).max(1e-9)
    }

    /// Whether the photographs show a lamp.
    pub fn is_found(&self) -> bool {
        self.share() >= MIN_SHARE
            && self.stops >= MIN_STOPS
            && self.distance_stops >= MIN_DISTANCE_STOPS
            && self.exponent >= MIN_EXPONENT
    }

    /// The reason of the decision, in a line.
    pub fn why(&self) -> String {
        format!(
            "distance and angle to the camera explain {:.2} stops or {:.0} % beyond exposures (thresholds {MIN_STOPS}, \
             {:.0} %), distance {:.2} (threshold {MIN_DISTANCE_STOPS}), exponent {:.1} (threshold {MIN_EXPONENT})",
            self.stops,
            100.0 * self.share().max(0.0),
            100.0 * MIN_SHARE,
            self.distance_stops,
            self.exponent
        )
    }

    /// Measures observations.
    pub(super) fn new(rows: &LampObservations) -> Result<Self, String> {
        rows.check_distances()?;
        let (left, fit) = rayon::join(|| Left::new(rows), || rows.fit(ALL, true));
        let [exponent, k1, k2, ambient] = fit.coefficients;
        let stops = |more: f64, less: f64| (more - less).max(0.0).sqrt();
        let share = |variance: f64| 1.0 - variance / left.total.max(f64::MIN_POSITIVE);
        Ok(Self {
            exponent,
            falloff: [k1, k2].map(|k| k * std::f64::consts::LN_2),
            ambient,
            d_ref: rows.d_ref,
            r_squared: share(left.by_both),
            stops: stops(left.by_exposures, left.by_both),
            exposure_r_squared: share(left.by_exposures),
            lamp_r_squared: share(left.by_lamp),
            spread: left.total.sqrt(),
            distance_stops: stops(left.by_angle, left.by_both),
            exposure_spread: deviation(fit.exposures.into_iter().flatten()).unwrap_or(0.0),
            points: rows.groups.len(),
        })
    }
}

/// What lens and shutter do to the light of views with these names, each measured on what the other leaves; `corner` is
/// u at the corner that is farthest from the axis. The observations are returned without bands.
pub(super) fn shading(
    rows: LampObservations,
    names: &[&str],
    corner: f64,
) -> (FalloffDiagnosis, BandsDiagnosis, LampObservations) {
    let falloff = FalloffDiagnosis::new(&rows, corner);
    let fall = if falloff.is_found() { rows.fall(falloff.falloff) } else { vec![] };
    let raised: Vec<f64> = fall.iter().map(|stops| -stops).collect();
    let rows = rows.without(&fall);
    let (bands, in_rows) = BandsDiagnosis::new(&rows, names);
    let rows = rows.without(&in_rows).without(&raised);
    let falloff = if bands.is_found() { FalloffDiagnosis::new(&rows, corner) } else { falloff };
    (falloff, bands, rows)
}

/// The variances of a point's brightness over its views that causes leave, on points that they were not fitted to.
struct Left {
    /// Without any cause.
    total: f64,
    by_exposures: f64,
    by_lamp: f64,
    /// By exposures and the lamp's angle.
    by_angle: f64,
    /// By exposures and lamp.
    by_both: f64,
}

impl Left {
    fn new(rows: &LampObservations) -> Self {
        let left = |terms, with_exposures| {
            let of_fold = |fold: usize| {
                let fit = rows.part(|group| group % FOLDS != fold).fit(terms, with_exposures);
                rows.part(|group| group % FOLDS == fold).residuals(&fit)
            };
            trimmed_variance((0..FOLDS).into_par_iter().flat_map_iter(of_fold).collect())
        };
        Self {
            total: left(NOTHING, false),
            by_exposures: left(NOTHING, true),
            by_lamp: left(LOG_LINEAR, false),
            by_angle: left(ANGLE, true),
            by_both: left(LOG_LINEAR, true),
        }
    }
}

/// The mean square without the largest values.
fn trimmed_variance(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(|a, b| a.abs().total_cmp(&b.abs()));
    values.truncate((values.len() as f64 * (1.0 - TRIMMED)).ceil() as usize);
    values.iter().map(|value| value * value).sum::<f64>() / values.len().max(1) as f64
}
