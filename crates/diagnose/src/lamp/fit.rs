//! The robust fit of albedos, exposures and a lamp to observations.

use std::collections::BTreeSet;
use std::f64::consts::LN_2;
use std::ops::Range;

use super::super::geometry::{Observation, median};
use super::trimmed_variance;

/// The fewest views and points.
const MIN_VIEWS: usize = 5;
const MIN_POINTS: usize = 100;
/// The smallest standard deviation of a point's distance over its views, as log2.
const MIN_DISTANCES: f64 = 0.05;
/// The most observations that are fitted to.
const MAX_OBSERVATIONS: usize = 40_000;

/// The number of terms of a lamp: exponent, k1, k2 and ambient.
const TERMS: usize = 4;

/// Which terms are fitted; the others are 0.
pub(super) type Terms = [bool; TERMS];

pub(super) const NOTHING: Terms = [false; TERMS];
pub(super) const ANGLE: Terms = [false, true, true, false];
/// All in which the logarithm of the light is linear.
pub(super) const LOG_LINEAR: Terms = [true, true, true, false];
pub(super) const ALL: Terms = [true; TERMS];

/// The largest coefficients; the smallest are 0.
const BOUNDS: [f64; TERMS] = [4.0, 100.0, 1000.0, 0.5];

/// The observations that are fitted to, in columns, with the range of each point's.
pub(in super::super) struct LampObservations {
    pub(super) view: Vec<usize>,
    /// log2 of the brightness.
    light: Vec<f64>,
    /// log2 (distance / `d_ref`).
    distance: Vec<f64>,
    /// u.
    off_axis: Vec<f64>,
    /// The position in the photograph's height, 0 to 1.
    pub(super) row: Vec<f64>,
    pub(super) groups: Vec<Range<usize>>,
    pub(super) views: usize,
    pub(super) d_ref: f64,
}

/// Coefficients of the terms, and the exposure of each view that has observations.
pub(super) struct LampFit {
    pub(super) coefficients: [f64; TERMS],
    pub(super) exposures: Vec<Option<f64>>,
}

impl LampObservations {
    /// The unclipped observations of points that two views see.
    pub(in super::super) fn new(points: &[Vec<Observation>], views: usize) -> Result<Self, String> {
        let clean = |point: &Vec<Observation>| -> Vec<Observation> {
            point.iter().copied().filter(|one| !one.is_clipped).collect()
        };
        let points: Vec<_> = points.iter().map(clean).filter(|seen| seen.len() >= 2).collect();
        let seeing: BTreeSet<usize> = points.iter().flatten().map(|one| one.view).collect();
        if points.len() < MIN_POINTS || seeing.len() < MIN_VIEWS {
            return Err(format!(
                "{} points in {} views are unclipped in two of them; {MIN_POINTS} in {MIN_VIEWS} are needed",
                points.len(),
                seeing.len()
            ));
        }
        let count = points.iter().map(Vec::len).sum::<usize>();
        let distances = points.iter().flatten().map(|one| one.distance);
        let mut rows = Self::empty(views, median(distances.collect()).unwrap_or(1.0));
        for point in points.iter().step_by(count.div_ceil(MAX_OBSERVATIONS)) {
            let start = rows.view.len();
            for one in point {
                rows.view.push(one.view);
                rows.light.push(one.light);
                rows.distance.push((one.distance / rows.d_ref).log2());
                rows.off_axis.push(one.off_axis);
                rows.row.push(one.row);
            }
            rows.groups.push(start..rows.view.len());
        }
        Ok(rows)
    }

    /// With a column, of values in stops, taken from the brightness.
    pub(super) fn without(mut self, column: &[f64]) -> Self {
        self.light.iter_mut().zip(column).for_each(|(light, value)| *light -= value);
        self
    }

    /// log2 of exp(-a u - b u^2) in each observation.
    pub(super) fn fall(&self, [a, b]: [f64; 2]) -> Vec<f64> {
        self.off_axis.iter().map(|u| -(a * u + b * u * u) / LN_2).collect()
    }

    /// Refuses points whose distances from their cameras hardly differ.
    pub(super) fn check_distances(&self) -> Result<(), String> {
        let spread = trimmed_variance(self.less_point(self.distance.clone())).sqrt();
        let percent = |stops: f64| 100.0 * (stops.exp2() - 1.0);
        if spread >= MIN_DISTANCES {
            return Ok(());
        }
        Err(format!(
            "the distances of a point from its cameras differ by {:.1} %; {:.1} % is needed",
            percent(spread),
            percent(MIN_DISTANCES)
        ))
    }

    fn empty(views: usize, d_ref: f64) -> Self {
        let (view, groups) = (vec![], vec![]);
        let [light, distance, off_axis, row] = [const { vec![] }; 4];
        Self { view, light, distance, off_axis, row, groups, views, d_ref }
    }

    /// The points of the groups whose indices a predicate takes.
    pub(super) fn part(&self, takes: impl Fn(usize) -> bool) -> Self {
        let mut part = Self::empty(self.views, self.d_ref);
        for (_, rows) in self.groups.iter().enumerate().filter(|(group, _)| takes(*group)) {
            let start = part.view.len();
            part.view.extend_from_slice(&self.view[rows.clone()]);
            part.light.extend_from_slice(&self.light[rows.clone()]);
            part.distance.extend_from_slice(&self.distance[rows.clone()]);
            part.off_axis.extend_from_slice(&self.off_axis[rows.clone()]);
            part.row.extend_from_slice(&self.row[rows.clone()]);
            part.groups.push(start..part.view.len());
        }
        part
    }

    /// Fits some terms and, if asked, exposures: Gauss-Newton steps within the bounds, with Huber's weights.
    pub(super) fn fit(&self, terms: Terms, with_exposures: bool) -> LampFit {
        const LINEAR_ROUNDS: usize = 5;
        const ROUNDS: usize = 10;
        let mut weights = vec![1.0; self.view.len()];
        let mut coefficients = [0.0; TERMS];
        let left = |coefficients, weights: &[f64]| {
            let mut left: Vec<f64> =
                self.light.iter().zip(self.lamp(coefficients)).map(|(a, b)| a - b).collect();
            let exposures = self.project(&mut left, weights, with_exposures);
            (left, exposures)
        };
        let rounds = if terms == ALL { ROUNDS } else { LINEAR_ROUNDS };
        for round in 0..rounds {
            // The linear terms come first, so that the others start close to their values.
            let is_on = |term: usize| terms[term] && (LOG_LINEAR[term] || round >= LINEAR_ROUNDS);
            let (residuals, _) = left(coefficients, &weights);
            let mut slopes = self.slopes(coefficients);
            for (_, slope) in slopes.iter_mut().enumerate().filter(|(term, _)| is_on(*term)) {
                self.project(slope, &weights, with_exposures);
            }
            let next = minimum(&slopes, &residuals, &weights, coefficients, is_on);
            let loss = |residuals: &[f64]| -> f64 {
                residuals.iter().zip(&weights).map(|(r, w)| w * r * r).sum()
            };
            // The first of ever shorter steps that gains.
            let steps = (0..6).map(|halvings| {
                let step = 0.5_f64.powi(halvings);
                let between = |term: usize| (1.0 - step) * coefficients[term] + step * next[term];
                let shorter = std::array::from_fn(between);
                (shorter, left(shorter, &weights).0)
            });
            let before = loss(&residuals);
            let gained = steps.into_iter().find(|(_, residuals)| loss(residuals) < before);
            let residuals = gained.map_or(residuals, |(shorter, residuals)| {
                coefficients = shorter;
                residuals
            });
            weights = huber_weights(&residuals);
        }
        LampFit { coefficients, exposures: left(coefficients, &weights).1 }
    }

    /// k1 and k2 of k1 u + k2 u^2, the stops by which light falls, beside exposures.
    pub(super) fn fit_falloff(&self) -> [f64; 2] {
        const ROUNDS: usize = 6;
        let mut weights = vec![1.0; self.view.len()];
        let mut found = nalgebra::Vector2::zeros();
        for _ in 0..ROUNDS {
            let projected = |mut column: Vec<f64>| {
                self.project(&mut column, &weights, true);
                column
            };
            let light = projected(self.light.clone());
            let slopes = [1, 2].map(|power| {
                projected(self.off_axis.iter().map(|u: &f64| -u.powi(power)).collect())
            });
            let dot = |a: &[f64], b: &[f64]| -> f64 {
                a.iter().zip(b).zip(&weights).map(|((a, b), weight)| weight * a * b).sum()
            };
            let normal = nalgebra::Matrix2::from_fn(|i, j| dot(&slopes[i], &slopes[j]));
            let right = nalgebra::Vector2::from_fn(|i, _| dot(&slopes[i], &light));
            let Some(solved) = normal.lu().solve(&right) else { break };
            found = solved;
            let left =
                |row: usize| light[row] - found[0] * slopes[0][row] - found[1] * slopes[1][row];
            let left: Vec<f64> = (0..light.len()).map(left).collect();
            weights = huber_weights(&left);
        }
        found.into()
    }

    /// u beyond which this share of the observations is.
    pub(super) fn outermost(&self, share: f64) -> f64 {
        let mut sorted = self.off_axis.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let index = ((1.0 - share) * sorted.len() as f64) as usize;
        sorted.get(index).copied().unwrap_or(0.0)
    }

    /// What points and exposures leave of the brightness less a column, with the weights of a robust fit.
    pub(super) fn left_by_exposures(&self, less: Option<&[f64]>) -> (Vec<f64>, Vec<f64>) {
        const ROUNDS: usize = 3;
        let mut weights = vec![1.0; self.view.len()];
        let mut left = vec![];
        for _ in 0..ROUNDS {
            let less = |row: usize| less.map_or(0.0, |less| less[row]);
            left = self.light.iter().enumerate().map(|(row, light)| light - less(row)).collect();
            self.project(&mut left, &weights, true);
            weights = huber_weights(&left);
        }
        (left, weights)
    }

    /// What a fit to other points leaves of the brightness, about the median of each point; without the views that
    /// have no exposure.
    pub(super) fn residuals(&self, fit: &LampFit) -> Vec<f64> {
        let lamp = self.lamp(fit.coefficients);
        let row = |row: usize| Some(self.light[row] - lamp[row] - fit.exposures[self.view[row]]?);
        let of_point = |rows: &Range<usize>| {
            let lights: Vec<f64> = rows.clone().filter_map(row).collect();
            let middle = median(lights.clone()).unwrap_or(0.0);
            lights.into_iter().map(move |one| one - middle)
        };
        self.groups.iter().flat_map(of_point).collect()
    }

    /// A column about the median of each point.
    fn less_point(&self, column: Vec<f64>) -> Vec<f64> {
        let of_point = |rows: &Range<usize>| {
            let group = &column[rows.clone()];
            let middle = median(group.to_vec()).unwrap_or(0.0);
            group.iter().map(move |one| one - middle).collect::<Vec<_>>()
        };
        self.groups.iter().flat_map(of_point).collect()
    }

    /// The log2 light of a lamp in every row.
    fn lamp(&self, [exponent, k1, k2, ambient]: [f64; TERMS]) -> Vec<f64> {
        let row = |(distance, u): (&f64, &f64)| {
            let fall = -exponent * distance - k1 * u - k2 * u * u;
            if ambient == 0.0 { fall } else { (ambient + (1.0 - ambient) * fall.exp2()).log2() }
        };
        self.distance.iter().zip(&self.off_axis).map(row).collect()
    }

    /// The derivative of [`Self::lamp`] by each coefficient.
    fn slopes(&self, [exponent, k1, k2, ambient]: [f64; TERMS]) -> [Vec<f64>; TERMS] {
        let fall = self.lamp([exponent, k1, k2, 0.0]);
        let row = |row: usize| {
            let (distance, u) = (self.distance[row], self.off_axis[row]);
            let fall = fall[row].exp2().max(f64::MIN_POSITIVE);
            let whole = ambient + (1.0 - ambient) * fall;
            let share = (1.0 - ambient) * fall / whole;
            [-share * distance, -share * u, -share * u * u, (1.0 - fall) / (whole * LN_2)]
        };
        let rows: Vec<[f64; TERMS]> = (0..fall.len()).map(row).collect();
        std::array::from_fn(|term| rows.iter().map(|row| row[term]).collect())
    }

    /// Removes from a column what a value for each point and, if asked, for each view explains, by weighted least
    /// squares. Returns the values of the views, with mean 0; without them, zeros.
    ///
    /// The points are eliminated; conjugate gradients, preconditioned by the weights of the views, solve for these.
    fn project(&self, column: &mut [f64], weights: &[f64], with_views: bool) -> Vec<Option<f64>> {
        const ROUNDS: usize = 60;
        const PRECISION: f64 = 1e-5;
        let mut of_views = vec![0.0; self.views];
        self.less_points(column, weights);
        if !with_views {
            return of_views.into_iter().map(Some).collect();
        }
        let total = self.sums_of_views(&vec![1.0; weights.len()], weights);
        let scaled = |sums: &[f64]| -> Vec<f64> {
            let mean = |(sum, total): (&f64, &f64)| if *total > 0.0 { sum / total } else { 0.0 };
            sums.iter().zip(&total).map(mean).collect()
        };
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let left = self.sums_of_views(column, weights);
        let mut means = scaled(&left);
        let (mut direction, mut square) = (means.clone(), dot(&left, &means));
        for _ in 0..ROUNDS {
            if means.iter().all(|mean| mean.abs() < PRECISION) {
                break;
            }
            let mut along: Vec<f64> = self.view.iter().map(|&view| direction[view]).collect();
            self.less_points(&mut along, weights);
            let curvature = dot(&direction, &self.sums_of_views(&along, weights));
            if curvature <= f64::MIN_POSITIVE {
                break;
            }
            let step = square / curvature;
            column.iter_mut().zip(&along).for_each(|(one, along)| *one -= step * along);
            of_views.iter_mut().zip(&direction).for_each(|(all, along)| *all += step * along);
            let left = self.sums_of_views(column, weights);
            means = scaled(&left);
            let before = std::mem::replace(&mut square, dot(&left, &means));
            let kept = square / before;
            direction
                .iter_mut()
                .zip(&means)
                .for_each(|(along, mean)| *along = mean + kept * *along);
        }
        let seen = || (0..self.views).filter(|&view| total[view] > 0.0);
        let mean = seen().map(|view| of_views[view]).sum::<f64>() / seen().count().max(1) as f64;
        let value = |view: usize| (total[view] > 0.0).then(|| of_views[view] - mean);
        (0..self.views).map(value).collect()
    }

    /// Takes the weighted mean of each point from a column.
    fn less_points(&self, column: &mut [f64], weights: &[f64]) {
        for rows in &self.groups {
            let weighted = column[rows.clone()].iter().zip(&weights[rows.clone()]);
            let [sum, weight] = weighted
                .fold([0.0; 2], |[sum, all], (one, weight)| [sum + weight * one, all + weight]);
            column[rows.clone()].iter_mut().for_each(|one| *one -= sum / weight);
        }
    }

    /// The weighted sum of a column in each view.
    fn sums_of_views(&self, column: &[f64], weights: &[f64]) -> Vec<f64> {
        let mut sums = vec![0.0; self.views];
        for ((&view, one), weight) in self.view.iter().zip(column).zip(weights) {
            sums[view] += weight * one;
        }
        sums
    }
}

/// Huber's weights of residuals.
fn huber_weights(residuals: &[f64]) -> Vec<f64> {
    const HUBER: f64 = 1.5;
    let scale = 1.4826 * median(residuals.iter().map(|r| r.abs()).collect()).unwrap_or(0.0);
    let weight = |residual: &f64| (HUBER * scale / residual.abs().max(1e-9)).clamp(1e-6, 1.0);
    residuals.iter().map(weight).collect()
}

/// The coefficients within the bounds at which the linearised, weighted square is smallest: coordinate descent.
fn minimum(
    slopes: &[Vec<f64>; TERMS],
    residuals: &[f64],
    weights: &[f64],
    from: [f64; TERMS],
    is_on: impl Fn(usize) -> bool,
) -> [f64; TERMS] {
    const SWEEPS: usize = 4000;
    let dot = |a: &[f64], b: &[f64]| -> f64 {
        a.iter().zip(b).zip(weights).map(|((a, b), weight)| weight * a * b).sum()
    };
    let normal = slopes.each_ref().map(|a| slopes.each_ref().map(|b| dot(a, b)));
    let start = slopes.each_ref().map(|slope| dot(slope, residuals));
    let mut found = from;
    for _ in 0..SWEEPS {
        let before = found;
        for term in (0..TERMS).filter(|&term| is_on(term) && normal[term][term] > 0.0) {
            let moved: f64 = (0..TERMS)
                .filter(|&other| is_on(other))
                .map(|other| normal[term][other] * (found[other] - from[other]))
                .sum();
            let change = (start[term] - moved) / normal[term][term];
            found[term] = (found[term] + change).clamp(0.0, BOUNDS[term]);
        }
        if found == before {
            break;
        }
    }
    found
}
