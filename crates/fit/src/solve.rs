//! Least squares: Levenberg-Marquardt within bounds, from several starts, with Huber's weights.

use levenberg_marquardt::{LeastSquaresProblem, LevenbergMarquardt};
use nalgebra::{DMatrix, DVector, Dyn, Owned};
use nightsplat_core::random::Stream;
use nightsplat_photographs::tone::{Constant, Statistics};

use super::model::{ChannelExposure, CurveOfT, FitModel, Slopes};
use super::{Channels, FitOptions, Histogram, Pair, Weighting};

/// Values with the same curve of t.
pub(super) struct Group {
    pub(super) exposure: ChannelExposure,
    /// Of t = x / p90.
    pub(super) histogram: Histogram,
}

/// The pairs with their weights, grouped by curve: a single group if only t matters.
fn groups(model: &FitModel, pairs: &[&Pair], weights: &[f64], options: &FitOptions) -> Vec<Group> {
    let all = pairs.iter().zip(weights).flat_map(|(pair, &weight)| {
        parts(model, pair, options.channels).into_iter().map(move |(exposure, histograms)| {
            let scaled = |histogram| (histogram, [1.0 / exposure.p90(), weight]);
            (exposure, histograms.into_iter().map(scaled).collect::<Vec<_>>())
        })
    });
    let group =
        |(exposure, parts)| Group { exposure, histogram: Histogram::pooled(parts, options.bins) };
    if model.differs_by_photograph() {
        all.map(group).collect()
    } else {
        vec![group((ChannelExposure::POOLED, all.flat_map(|(_, parts)| parts).collect()))]
    }
}

/// The fitted histograms of a pair, with their exposures.
pub(super) fn parts<'a>(
    model: &FitModel,
    pair: &'a Pair,
    channels: Channels,
) -> Vec<(ChannelExposure, Vec<&'a Histogram>)> {
    let exposure = |channel| ChannelExposure::new(pair.statistics, channel);
    if model.differs_by_channel() {
        return (0..3).map(|channel| (exposure(channel), vec![&pair.channels[channel]])).collect();
    }
    let histograms = match channels {
        Channels::Rgb => pair.channels.iter().collect(),
        Channels::Luminance => vec![&pair.luminance],
    };
    vec![(exposure(0), histograms)]
}

/// The number of fitted values of a pair, and the sums of their residuals and of the squares.
pub(super) fn pair_residuals(
    model: &FitModel,
    values: &[f64],
    pair: &Pair,
    channels: Channels,
) -> (f64, [f64; 2]) {
    let parts = parts(model, pair, channels).into_iter();
    let mut found = (0.0, [0.0; 2]);
    for (exposure, histogram) in
        parts.flat_map(|(exposure, parts)| parts.into_iter().map(move |part| (exposure, part)))
    {
        let pooled = if model.differs_by_photograph() { exposure } else { ChannelExposure::POOLED };
        let curve = model.curve(values, &pooled);
        let [sum, squares] = histogram.residuals(|x| curve.at(x / exposure.p90()));
        found.0 += histogram.count();
        found.1 = [found.1[0] + sum, found.1[1] + squares];
    }
    found
}

/// The result of a fit.
pub(super) struct Solution {
    pub(super) values: Vec<f64>,
    /// Of each pair; the mean over all values is 1.
    pub(super) weights: Vec<f64>,
    /// The residual beyond which weights decrease; `None` if all are equal.
    pub(super) delta: Option<f64>,
    /// Whether the clamped curve never falls, to within [`TOLERANCE`].
    pub(super) rises: bool,
    /// Whether the curve never exceeds 1, to within [`TOLERANCE`].
    pub(super) bounded: bool,
}

/// A column with its weight and its mean reference value, under the weights of its cells.
struct FitRow {
    group: usize,
    t: f64,
    /// The sum of all weights.
    weight: f64,
    y: f64,
}

/// Tolerated violation of a constraint.
const TOLERANCE: f64 = 1e-6;
/// Weights of a violated constraint relative to the residuals, in turn until it is satisfied.
const STRENGTHS: [f64; 3] = [1e1, 1e3, 1e5];
/// Number of points of t at which constraints are tested.
const GRID: usize = 128;
/// Constraints are tested at least up to this t.
const MIN_END: f64 = 3.0;
/// Number of random points to evaluate, and of the best among them to start from, in addition to the table's start.
const PLACES: usize = 24;
const STARTS: usize = 3;
/// Evaluations of a descent, per constant.
const PATIENCE: usize = 30;
/// Rounds of reweighting, and the number of them that estimate the residuals' scale again.
const ROUNDS: usize = 30;
const SCALE_ROUNDS: usize = 6;
/// The reweighting ends when no constant moves by more than this share of its range.
const SETTLED: f64 = 1e-6;
/// The smallest scale of the residuals: a quarter of an 8-bit code value, due to rounding.
const MIN_SCALE: f64 = 0.25 / 255.0;

pub(super) struct Solver<'a> {
    model: &'a FitModel,
    pairs: &'a [&'a Pair],
    options: &'a FitOptions,
    pub(super) groups: Vec<Group>,
    /// Points at which constraints are tested, for a photograph of mean statistics.
    grid: Vec<f64>,
    exposure: ChannelExposure,
}

impl<'a> Solver<'a> {
    pub(super) fn new(model: &'a FitModel, pairs: &'a [&'a Pair], options: &'a FitOptions) -> Self {
        let groups = groups(model, pairs, &vec![1.0; pairs.len()], options);
        let exposure = if model.differs_by_photograph() {
            let statistics: Vec<Statistics> = pairs.iter().map(|pair| pair.statistics).collect();
            ChannelExposure::new(Statistics::mean_of(&statistics).unwrap_or_default(), 0)
        } else {
            ChannelExposure::POOLED
        };
        let last = groups.iter().filter_map(|group| group.histogram.columns.last());
        let end = last.map(|column| column.x).fold(MIN_END, f64::max);
        // Evenly in t / (1 + t), like the columns.
        let t = |i: usize| {
            let share = i as f64 / (GRID - 1) as f64 * end / (1.0 + end);
            share / (1.0 - share)
        };
        let grid = (0..GRID).map(t).collect();
        Self { model, pairs, options, groups, grid, exposure }
    }

    pub(super) fn solve(&mut self) -> Solution {
        let FitOptions { huber, weighting, .. } = *self.options;
        let mut weights = vec![1.0; self.pairs.len()];
        let mut values = self.best_of_many_starts(&self.rows(&|_| 1.0, &[]));
        let mut delta = None;
        for round in 0..ROUNDS {
            if weighting == Weighting::Photographs {
                weights = self.weights(&values);
                self.groups = groups(self.model, self.pairs, &weights, self.options);
            } else if huber.is_infinite() {
                break;
            }
            if huber.is_finite() && round < SCALE_ROUNDS {
                delta = Some(huber * self.scale(&values));
            }
            let limit = delta.unwrap_or(f64::INFINITY);
            let weight =
                |residual: f64| if residual.abs() > limit { limit / residual.abs() } else { 1.0 };
            let after = self.minimize(&self.rows(&weight, &values), &values);
            let before = std::mem::replace(&mut values, after);
            let moved = self.model.free.iter().zip(before.iter().zip(&values)).map(
                |(constant, (before, after))| {
                    (before - after).abs() / (constant.bounds[1] - constant.bounds[0])
                },
            );
            if round >= SCALE_ROUNDS && moved.fold(0.0, f64::max) < SETTLED {
                break;
            }
        }
        let [fall, excess] = self.violations(&values);
        Solution { values, weights, delta, rises: fall <= TOLERANCE, bounded: excess <= TOLERANCE }
    }

    /// The weight of every pair: the inverse of its mean squared residual.
    fn weights(&self, values: &[f64]) -> Vec<f64> {
        let of_pair = |pair: &&Pair| {
            let (count, squares) = pair_residuals(self.model, values, pair, self.options.channels);
            (count, 1.0 / (squares[1] / count).max(MIN_SCALE * MIN_SCALE))
        };
        let weights: Vec<(f64, f64)> = self.pairs.iter().map(of_pair).collect();
        let mean = weights.iter().map(|(count, weight)| count * weight).sum::<f64>()
            / weights.iter().map(|(count, _)| count).sum::<f64>();
        weights.into_iter().map(|(_, weight)| weight / mean).collect()
    }

    /// The scale of the residuals: 1.4826 times the median of their magnitudes, the standard deviation if they are
    /// normal.
    fn scale(&self, values: &[f64]) -> f64 {
        (1.4826 * quantile(&mut self.sizes(values), 0.5)).max(MIN_SCALE)
    }

    /// The magnitude of every cell's residual, with its count.
    pub(super) fn sizes(&self, values: &[f64]) -> Vec<(f64, f64)> {
        let mut sizes = vec![];
        for (group, curve) in self.groups.iter().zip(self.curves(values)) {
            for column in &group.histogram.columns {
                let y = curve.at(column.x);
                sizes.extend(column.cells.iter().map(|cell| ((cell.y() - y).abs(), cell.count())));
            }
        }
        sizes
    }

    /// The curve of every group.
    fn curves(&self, values: &[f64]) -> Vec<CurveOfT<'_, f64>> {
        self.groups.iter().map(|group| self.model.curve(values, &group.exposure)).collect()
    }

    /// A row per column, drawn towards the family's own curve by the prior. The model has one value within a column, so
    /// only the weighted mean matters. Without values, cells are weighted by their counts.
    fn rows(&self, weight: &dyn Fn(f64) -> f64, values: &[f64]) -> Vec<FitRow> {
        let (mut rows, curves) = (vec![], self.curves(values));
        for (index, group) in self.groups.iter().enumerate() {
            for column in &group.histogram.columns {
                let t = column.x;
                let [weight, sum_y] = if values.is_empty() {
                    [column.count, column.sum_y]
                } else {
                    let model = curves[index].at(t);
                    column.cells.iter().fold([0.0; 2], |[sum, sum_y], cell| {
                        let weight = cell.count() * weight(cell.y() - model);
                        [sum + weight, sum_y + weight * cell.y()]
                    })
                };
                rows.push(FitRow { group: index, t, weight, y: sum_y / weight });
            }
        }
        let total: f64 = rows.iter().map(|row| row.weight).sum();
        let start: Vec<f64> = self.model.free.iter().map(|constant| constant.start).collect();
        let curves = self.curves(&start);
        let prior = self.options.prior / self.pairs.len() as f64;
        for row in &mut rows {
            row.weight /= total;
            if prior > 0.0 {
                row.y = (row.y + prior * curves[row.group].at(row.t)) / (1.0 + prior);
            }
        }
        rows
    }

    /// The best result of several starts.
    fn best_of_many_starts(&self, rows: &[FitRow]) -> Vec<f64> {
        let free = &self.model.free;
        let start: Vec<f64> = free.iter().map(|constant| constant.start).collect();
        let stream = Stream::new(u64::from(self.model.initial.curve.constant()), 0);
        let jittered = |draw: usize| -> Vec<f64> {
            let value = |(index, constant)| {
                let normal = stream.normal((draw * free.len() + index) as u64);
                within(constant, place_of(constant, constant_start(constant)) + 1.5 * normal)
            };
            free.iter().enumerate().map(value).collect()
        };
        let with_cost =
            |values: Vec<f64>| (self.problem(rows, &values, STRENGTHS[0]).cost(), values);
        let mut starts: Vec<(f64, Vec<f64>)> =
            (0..PLACES).map(|draw| with_cost(jittered(draw))).collect();
        starts.push(with_cost(free.iter().map(|constant| constant.default).collect()));
        starts.sort_by(|a, b| a.0.total_cmp(&b.0));
        let tried = std::iter::once(start).chain(starts.into_iter().map(|(_, start)| start));
        let found = tried.take(1 + STARTS).map(|start| with_cost(self.minimize(rows, &start)));
        found.min_by(|a, b| a.0.total_cmp(&b.0)).map_or_else(Vec::new, |(_, values)| values)
    }

    fn minimize(&self, rows: &[FitRow], start: &[f64]) -> Vec<f64> {
        let mut values = start.to_vec();
        for strength in STRENGTHS {
            let problem = self.problem(rows, &values, strength);
            let (problem, report) =
                LevenbergMarquardt::new().with_tol(1e-10).with_patience(PATIENCE).minimize(problem);
            tracing::trace!(
                "{}: {:?} after {}",
                self.model.initial.curve,
                report.termination,
                report.number_of_evaluations
            );
            values = problem.values;
            let [fall, excess] = self.violations(&values);
            if fall <= TOLERANCE && !(self.options.bounded && excess > TOLERANCE) {
                break;
            }
        }
        values
    }

    fn problem<'b>(&'b self, rows: &'b [FitRow], start: &[f64], strength: f64) -> Problem<'b> {
        let position =
            self.model.free.iter().zip(start).map(|(constant, value)| place_of(constant, *value));
        let position = DVector::from_iterator(start.len(), position);
        let mut problem =
            Problem { solver: self, rows, strength, values: vec![], position: DVector::zeros(0) };
        problem.set_params(&position);
        problem
    }

    /// The largest fall of the clamped curve between neighbouring points, and its largest excess over 1.
    fn violations(&self, values: &[f64]) -> [f64; 2] {
        self.broken(values)
            .into_iter()
            .fold([0.0; 2], |[fall, excess], [a, b]| [f64::max(fall, a), f64::max(excess, b)])
    }

    /// For every point of the grid, the fall of the clamped curve to the next, and its excess over 1.
    fn broken(&self, values: &[f64]) -> Vec<[f64; 2]> {
        let curve = self.model.curve(values, &self.exposure);
        let raw: Vec<f64> = self.grid.iter().map(|&t| curve.raw_at(t)).collect();
        let next = raw.iter().skip(1).chain(raw.last());
        let fall = |raw: f64, next: f64| (raw.clamp(0.0, 1.0) - next.clamp(0.0, 1.0)).max(0.0);
        raw.iter().zip(next).map(|(&raw, &next)| [fall(raw, next), (raw - 1.0).max(0.0)]).collect()
    }
}

/// The start, moved into the bounds.
fn constant_start(constant: &Constant) -> f64 {
    let [low, high] = constant.bounds;
    constant.start.clamp(low + 0.01 * (high - low), high - 0.01 * (high - low))
}

/// The unbounded value of a constant within its bounds: the logit of its share of the range.
fn place_of(constant: &Constant, value: f64) -> f64 {
    let [low, high] = constant.bounds;
    let share = ((value - low) / (high - low)).clamp(1e-6, 1.0 - 1e-6);
    (share / (1.0 - share)).ln()
}

/// Inverse of [`place_of`].
fn within(constant: &Constant, position: f64) -> f64 {
    let [low, high] = constant.bounds;
    low + (high - low) / (1.0 + (-position).exp())
}

/// The value below which `share` of the counts are, from (value, count); 0 if empty.
pub(super) fn quantile(sizes: &mut [(f64, f64)], share: f64) -> f64 {
    sizes.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let mut left = share * sizes.iter().map(|(_, count)| count).sum::<f64>();
    let found = sizes.iter().find(|(_, count)| {
        left -= count;
        left <= 0.0
    });
    found.map_or(0.0, |(size, _)| *size)
}

/// Residuals: one per row, then two per point of the grid, which are 0 if the constraint is satisfied.
struct Problem<'a> {
    solver: &'a Solver<'a>,
    rows: &'a [FitRow],
    strength: f64,
    values: Vec<f64>,
    position: DVector<f64>,
}

impl Problem<'_> {
    fn cost(&self) -> f64 {
        self.all_residuals().norm_squared()
    }

    fn is_constrained(&self) -> bool {
        self.solver.model.has_shape()
    }

    fn all_residuals(&self) -> DVector<f64> {
        let curves = self.solver.curves(&self.values);
        let residual = |row: &FitRow| row.weight.sqrt() * (curves[row.group].at(row.t) - row.y);
        let mut residuals: Vec<f64> = self.rows.iter().map(residual).collect();
        if self.is_constrained() {
            let broken = self.solver.broken(&self.values);
            let bounded = self.solver.options.bounded;
            let excess = |excess: f64| if bounded { excess } else { 0.0 };
            let broken = broken.into_iter().flat_map(|[fall, above]| [fall, excess(above)]);
            residuals.extend(broken.map(|amount| self.strength * amount));
        }
        DVector::from_vec(residuals)
    }
}

impl LeastSquaresProblem<f64, Dyn, Dyn> for Problem<'_> {
    type ResidualStorage = Owned<f64, Dyn>;
    type JacobianStorage = Owned<f64, Dyn, Dyn>;
    type ParameterStorage = Owned<f64, Dyn>;

    fn set_params(&mut self, position: &DVector<f64>) {
        let free = &self.solver.model.free;
        self.values = free
            .iter()
            .zip(position)
            .map(|(constant, &position)| within(constant, position))
            .collect();
        self.position.clone_from(position);
    }

    fn params(&self) -> DVector<f64> {
        self.position.clone()
    }

    fn residuals(&self) -> Option<DVector<f64>> {
        Some(self.all_residuals())
    }

    fn jacobian(&self) -> Option<DMatrix<f64>> {
        let Solver { model, ref groups, options, ref grid, ref exposure, .. } = *self.solver;
        let values = &self.values;
        let constrained = if self.is_constrained() { 2 * grid.len() } else { 0 };
        let mut jacobian = DMatrix::zeros(self.rows.len() + constrained, values.len());
        let slope = |index: usize| {
            let [low, high] = model.free[index].bounds;
            (values[index] - low) * (high - values[index]) / (high - low)
        };
        let slopes: Vec<f64> = (0..values.len()).map(slope).collect();
        let mut set = |row: usize, factor: f64, gradient: &mut dyn Iterator<Item = f64>| {
            for (index, derivative) in gradient.enumerate() {
                jacobian[(row, index)] += factor * derivative * slopes[index];
            }
        };
        let of_group = |group: &Group| model.slopes(values, &group.exposure);
        let of_groups: Vec<Slopes<'_>> = groups.iter().map(of_group).collect();
        for (index, row) in self.rows.iter().enumerate() {
            set(index, row.weight.sqrt(), &mut of_groups[row.group].at(row.t));
        }
        if constrained > 0 {
            let on_grid = model.slopes(values, exposure);
            for (index, [fall, excess]) in self.solver.broken(values).into_iter().enumerate() {
                let row = self.rows.len() + 2 * index;
                if fall > 0.0 {
                    set(row, self.strength, &mut on_grid.at(grid[index]));
                    set(row, -self.strength, &mut on_grid.at(grid[index + 1]));
                }
                if options.bounded && excess > 0.0 {
                    set(row + 1, self.strength, &mut on_grid.raw_at(grid[index]));
                }
            }
        }
        Some(jacobian)
    }
}
