//! Bands of rows: lamps on mains flicker, and a rolling shutter exposes rows one after another. The bands have one
//! period in all photographs, and another phase in each.
//!
//! ```text
//! log2 brightness(p, v) = albedo_p + exposure_v + C_v cos(2 pi n y) + S_v sin(2 pi n y)
//! ```
//!
//! What all photographs have in common is no band but a lens or a beam: only how far waves are from their mean shows
//! bands.

use std::f64::consts::{LN_2, TAU};

use nightsplat_photographs::dataset::RowBands;
use rayon::prelude::*;
use serde::Serialize;

use super::fit::LampObservations;

/// The most periods that are tried, in photographs' heights.
const MAX_PERIODS: usize = 12;
/// Steps between the periods that are tried in a height: first these, then those around the best of them.
const STEPS: [usize; 2] = [4, 32];
/// The fewest points of a view, so that chance explains little.
const MIN_POINTS: usize = 30;
/// Bands explain at least this share of the variance that points and exposures leave.
const MIN_SHARE: f64 = 0.2;
/// The smallest difference between bright and dark rows, stops.
const MIN_STOPS: f64 = 0.3;
/// Rounds in which bands and the brightness of points are fitted in turn: points take a part of the bands at first.
const ROUNDS: usize = 40;

/// Bands of rows as points show them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BandsDiagnosis {
    /// Their number and the wave of each photograph.
    pub rows: RowBands,
    /// The share that they explain of the variance which points and exposures leave.
    pub share: f64,
    /// The difference between bright and dark rows, stops; 0 for a small share.
    pub stops: f64,
    /// Whether the photographs were loaded without them.
    pub is_corrected: bool,
}

impl BandsDiagnosis {
    /// Measures observations of views with these names; also returns the bands in each observation, stops.
    pub(super) fn new(rows: &LampObservations, names: &[&str]) -> (Self, Vec<f64>) {
        let (left, weights) = rows.left_by_exposures(None);
        let share = |count: f64| {
            rows.share_of(&rows.waves(&left, &weights, count).about_mean(), &left, &weights)
        };
        let best = |first: f64, steps: usize, per_height: usize| {
            let counts =
                (0..=steps).into_par_iter().map(|step| first + step as f64 / per_height as f64);
            let shares: Vec<(f64, f64)> = counts.map(|count| (share(count), count)).collect();
            shares.into_iter().max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or_default()
        };
        let [coarse, fine] = STEPS;
        let (_, near) = best(1.0, coarse * (MAX_PERIODS - 1), coarse);
        let (share, count) = best(near - 1.0 / coarse as f64, 2 * fine / coarse, fine);
        let mut bands = Waves { count, of_view: vec![[0.0; 2]; names.len()] };
        for _ in 0..if share < MIN_SHARE { 0 } else { ROUNDS } {
            let (left, weights) = rows.left_by_exposures(Some(&rows.bands(&bands)));
            let more = rows.waves(&left, &weights, count);
            for (sum, more) in bands.of_view.iter_mut().zip(more.of_view) {
                *sum = [sum[0] + more[0], sum[1] + more[1]];
            }
        }
        let column = rows.bands(&bands);
        // The root mean square of a sine is 1 / sqrt(8) of its height.
        let mean = column.iter().map(|band| band * band).sum::<f64>() / column.len().max(1) as f64;
        let named = names.iter().zip(&bands.of_view).filter(|(_, wave)| **wave != [0.0; 2]);
        let waves = named.map(|(name, &wave)| ((*name).to_owned(), of_light(wave))).collect();
        let rows = RowBands { count, waves };
        (Self { rows, share, stops: (8.0 * mean).sqrt(), is_corrected: false }, column)
    }

    /// Whether rows differ, and it is known by how much.
    pub fn is_found(&self) -> bool {
        self.share >= MIN_SHARE && self.stops >= MIN_STOPS
    }

    /// The measurement in a line.
    pub fn why(&self) -> String {
        let Self { rows: RowBands { count, .. }, share, stops, .. } = self;
        if !self.is_found() {
            return format!(
                "bands of rows explain {:.0} % of what points differ by between views, {stops:.1} stops (thresholds \
                 {:.0} %, {MIN_STOPS})",
                100.0 * share.max(0.0),
                100.0 * MIN_SHARE
            );
        }
        format!(
            "rows differ by {stops:.1} stops within a photograph, in {count:.1} bands that lie elsewhere in each: \
             lamps on mains flicker under a rolling shutter; expose for a multiple of 1/100 s (1/120 s on 60 Hz)"
        )
    }
}

/// The factors of light of a wave of its logarithm to base 2: ln(1 + m cos x) is a constant and 2 q cos x with
/// m = 2 q / (1 + q^2), and higher harmonics.
fn of_light(wave: [f64; 2]) -> [f64; 2] {
    let q = 0.5 * LN_2 * wave[0].hypot(wave[1]);
    wave.map(|part| LN_2 * part / (1.0 + q * q))
}

/// Waves over the height, of another phase and height in each view, stops.
struct Waves {
    count: f64,
    of_view: Vec<[f64; 2]>,
}

impl Waves {
    /// Less the mean of the views that have a wave.
    fn about_mean(mut self) -> Self {
        let has_wave = |wave: &&mut [f64; 2]| **wave != [0.0; 2];
        let waves: Vec<&mut [f64; 2]> = self.of_view.iter_mut().filter(has_wave).collect();
        let count = waves.len().max(1) as f64;
        let mean = [0, 1].map(|part| waves.iter().map(|wave| wave[part]).sum::<f64>() / count);
        for wave in waves {
            *wave = [wave[0] - mean[0], wave[1] - mean[1]];
        }
        self
    }
}

impl LampObservations {
    /// The waves that fit a column best.
    fn waves(&self, column: &[f64], weights: &[f64], count: f64) -> Waves {
        let mut sums =
            vec![(nalgebra::Matrix3::zeros(), nalgebra::Vector3::zeros(), 0); self.views];
        for (index, (&view, &row)) in self.view.iter().zip(&self.row).enumerate() {
            let (sine, cosine) = (TAU * count * row).sin_cos();
            let basis = nalgebra::Vector3::new(1.0, cosine, sine);
            let (normal, right, points) = &mut sums[view];
            *normal += basis * basis.transpose() * weights[index];
            *right += basis * (column[index] * weights[index]);
            *points += 1;
        }
        let solved = sums.into_iter().map(|(normal, right, points)| {
            let solved = normal.lu().solve(&right).filter(|_| points >= MIN_POINTS);
            solved.map_or([0.0; 2], |solved| [solved[1], solved[2]])
        });
        Waves { count, of_view: solved.collect() }
    }

    /// Waves in each observation.
    fn bands(&self, Waves { count, of_view }: &Waves) -> Vec<f64> {
        let one = |(&view, &row): (&usize, &f64)| {
            let (sine, cosine) = (TAU * count * row).sin_cos();
            of_view[view][0] * cosine + of_view[view][1] * sine
        };
        self.view.iter().zip(&self.row).map(one).collect()
    }

    /// The share of a column's variance that waves explain.
    fn share_of(&self, waves: &Waves, column: &[f64], weights: &[f64]) -> f64 {
        let weighted = |values: &mut dyn Iterator<Item = f64>| -> f64 {
            values.zip(weights).map(|(value, weight)| weight * value * value).sum()
        };
        let total = weighted(&mut column.iter().copied());
        let bands = self.bands(waves);
        let left = weighted(&mut column.iter().zip(&bands).map(|(one, band)| one - band));
        1.0 - left / total.max(f64::MIN_POSITIVE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wave_of_light_follows_from_that_of_its_logarithm() {
        for m in [0.05_f64, 0.35, 0.8] {
            // The first harmonic of log2(1 + m cos x), by its mean with 2 cos x.
            let steps = 4096;
            let sum: f64 = (0..steps)
                .map(|step| (TAU * f64::from(step) / f64::from(steps)).cos())
                .map(|cosine| 2.0 * cosine * (1.0 + m * cosine).log2())
                .sum();
            let [c, s] = of_light([sum / f64::from(steps), 0.0]);
            assert!((c - m).abs() < 1e-6 && s == 0.0, "{c} for {m}");
        }
    }
}
