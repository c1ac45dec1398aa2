//! Bands of rows: lamps on mains flicker, and a rolling shutter exposes rows one after another. The bands have one
//! period in all photographs, and another phase in each.

use super::fit::LampObservations;

/// Periods that are tried, in photographs' heights: a quarter of one apart, up to this number.
const MAX_PERIODS: usize = 12;
/// The fewest points of a view, so that chance explains little.
const MIN_POINTS: usize = 30;
/// Bands explain at least this share of the variance that points and exposures leave.
const MIN_SHARE: f64 = 0.2;
/// The smallest difference between bright and dark rows, stops.
const MIN_STOPS: f64 = 0.3;
/// Rounds in which bands and the brightness of points are fitted in turn.
const ROUNDS: usize = 12;

/// A remark on bands of rows, if points show them.
pub(in super::super) fn remark(rows: &LampObservations) -> Option<String> {
    let (left, weights) = rows.left_by_exposures(None);
    let periods = (4..=4 * MAX_PERIODS).map(|quarters| quarters as f64 / 4.0);
    let explained = periods.map(|periods| (rows.bands(&left, &weights, periods).1, periods));
    let (share, periods) = explained.max_by(|a, b| a.0.total_cmp(&b.0))?;
    if share < MIN_SHARE {
        return None;
    }
    let mut bands = vec![0.0; left.len()];
    for _ in 0..ROUNDS {
        let (left, weights) = rows.left_by_exposures(Some(&bands));
        let more = rows.bands(&left, &weights, periods).0;
        bands.iter_mut().zip(more).for_each(|(band, more)| *band += more);
    }
    // The root mean square of a sine is 1 / sqrt(8) of its height.
    let mean = bands.iter().map(|band| band * band).sum::<f64>() / bands.len().max(1) as f64;
    let stops = (8.0 * mean).sqrt();
    (stops >= MIN_STOPS).then(|| {
        format!(
            "rows differ by {stops:.1} stops within a photograph, in {periods:.1} bands that lie elsewhere in each: \
             lamps on mains flicker under a rolling shutter; expose for a multiple of 1/100 s (1/120 s on 60 Hz)"
        )
    })
}

impl LampObservations {
    /// Waves of `periods` over the height, of another phase and height in each view, that fit a column best; and the
    /// share of its variance that they explain.
    fn bands(&self, column: &[f64], weights: &[f64], periods: f64) -> (Vec<f64>, f64) {
        let wave = |row: f64| {
            let (sine, cosine) = (std::f64::consts::TAU * periods * row).sin_cos();
            [1.0, cosine, sine]
        };
        let mut sums =
            vec![(nalgebra::Matrix3::zeros(), nalgebra::Vector3::zeros(), 0); self.views];
        for (index, (&view, &row)) in self.view.iter().zip(&self.row).enumerate() {
            let basis = nalgebra::Vector3::from(wave(row));
            let (normal, right, count) = &mut sums[view];
            *normal += basis * basis.transpose() * weights[index];
            *right += basis * (column[index] * weights[index]);
            *count += 1;
        }
        let solve =
            |(normal, right, count): (nalgebra::Matrix3<f64>, nalgebra::Vector3<f64>, usize)| {
                let solved = normal.lu().solve(&right).filter(|_| count >= MIN_POINTS);
                solved.unwrap_or_default()
            };
        let solved: Vec<nalgebra::Vector3<f64>> = sums.into_iter().map(solve).collect();
        let fitted = |(&view, &row): (&usize, &f64)| {
            let [_, cosine, sine] = wave(row);
            solved[view][1] * cosine + solved[view][2] * sine
        };
        let bands: Vec<f64> = self.view.iter().zip(&self.row).map(fitted).collect();
        let weighted = |values: &mut dyn Iterator<Item = f64>| -> f64 {
            values.zip(weights).map(|(value, weight)| weight * value * value).sum()
        };
        let total = weighted(&mut column.iter().copied());
        let left = weighted(&mut column.iter().zip(&bands).map(|(one, band)| one - band));
        (bands, 1.0 - left / total.max(f64::MIN_POSITIVE))
    }
}
