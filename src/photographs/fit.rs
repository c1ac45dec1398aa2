//! The constants of a tone curve from pairs of photographs, one dark and one in normal light.
//!
//! The model is y = f(t), t = x / p90 of each photograph, y the reference value; least squares over all pixels:
//!
//! ```text
//! pairs -> joint histogram of (t, y) -> Levenberg-Marquardt on its columns, reweighted after Huber -> constants
//! ```
//!
//! A histogram's column holds all pixels of one t, so that the cost of a fit does not depend on how many there are.
//! Bounds hold by construction (each constant is a logistic function of what is solved for), monotonicity by a penalty
//! that grows until it holds. Residuals beyond `huber` times their scale (1.4826 times their median size) weigh as much
//! less as they are larger (Huber 1964). Photographs weigh as [`Weighting`] says.
//!
//! Standard errors are those of Huber's estimator (Huber 1973) for an effective number of values: pixels of one photograph
//! err together, and their intraclass correlation rho, from the photographs' mean residuals, makes N values in groups of m
//! as good as N / (1 + (m - 1) rho). They assume that photographs are independent, that the model is right, and that errors
//! differ between photographs by a shift only; of a single photograph rho is unknown and counts as 0.

mod confidence;
mod histogram;
mod model;
mod pairs;
mod profile;
mod solve;
mod validate;

use serde::Serialize;

pub use self::histogram::{Cell, Column, Histogram};
use self::model::Model;
pub use self::model::psnr;
pub use self::pairs::{FitScene, Pair};
pub use self::profile::{
    ColourPair, ColourScene, ProfileFold, ProfileScores, cross_validate_profile, fit_profile,
    profile_scores,
};
use self::solve::{Solution, Solver, pair_residuals, parts, quantile};
pub use self::validate::{Fold, HeldOut, cross_validate};
use crate::photographs::tone::{Family, ToneCurve, ToneSettings};
use crate::{Error, Result};

/// Which values of a photograph are fitted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Channels {
    /// Red, green and blue, each a value: what the curve is applied to.
    #[default]
    Rgb,
    /// The luminance.
    Luminance,
}

/// What each photograph weighs in a fit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Weighting {
    /// Every pixel the same: the least mean squared error.
    #[default]
    Pixels,
    /// One over the mean of its squared residuals, found with the constants: the likeliest constants where photographs
    /// differ in how far they are from any curve. There may be several such fits, each close to some of the photographs.
    Photographs,
}

/// How a curve is fitted.
#[derive(Clone, Copy, Debug)]
pub struct FitOptions {
    /// Which values are fitted.
    pub channels: Channels,
    /// What each photograph weighs.
    pub weighting: Weighting,
    /// How many photographs the family's own constants count as: the fit is drawn to them, the less the more pairs.
    pub prior: f64,
    /// Residuals beyond this many times their scale weigh less; infinite for plain least squares.
    pub huber: f64,
    /// Columns of the histogram.
    pub bins: usize,
    /// Whether the curve may not pass 1 anywhere.
    pub bounded: bool,
    /// Whether black level and gain, alpha and c, are fitted with the constants of a family on t.
    pub adapt: bool,
}

impl Default for FitOptions {
    /// 1.345 is Huber's for 95 % efficiency where errors are normal.
    fn default() -> Self {
        Self {
            channels: Channels::Rgb,
            weighting: Weighting::Pixels,
            prior: 0.0,
            huber: 1.345,
            bins: 512,
            bounded: false,
            adapt: false,
        }
    }
}

impl FitOptions {
    fn check(&self) -> Result<()> {
        // Positive phrasing: a NaN fails the test too.
        let is_positive = self.huber > 0.0;
        if !is_positive {
            return Err(Error::Usage(format!(
                "huber is {}; it must be above 0, inf for plain least squares",
                self.huber
            )));
        }
        if !(self.prior >= 0.0 && self.prior.is_finite()) {
            let problem = format!("prior is {}; it must be finite and at least 0", self.prior);
            return Err(Error::Usage(problem));
        }
        if !(8..=65_536).contains(&self.bins) {
            return Err(Error::Usage(format!("bins is {}; it must be from 8 to 65536", self.bins)));
        }
        Ok(())
    }
}

/// A fitted constant.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// The constant's name.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// Its standard error; none at a bound, or where the pairs do not determine the constants one by one.
    pub standard_error: Option<f64>,
    /// Whether it lies at one of its bounds.
    pub at_bound: bool,
}

/// A family fitted to pairs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fit {
    /// The curve with the fitted constants, as `--curve` takes it.
    pub settings: ToneSettings,
    /// What was fitted.
    pub constants: Vec<Estimate>,
    /// The values fitted to: pixels times channels.
    pub values: f64,
    /// As many independent ones would say as much.
    pub effective_values: f64,
    /// The root of the mean squared residual, of values in [0, 1].
    pub rmse: f64,
    /// The median and the 95th percentile of the residuals' sizes, under the photographs' weights.
    pub residual_quantiles: [f64; 2],
    /// Where residuals begin to weigh less; none without robust weights.
    pub huber_delta: Option<f64>,
    /// The mean of Huber's loss under the photographs' weights; of half the squares without robust weights.
    pub robust_loss: f64,
    /// The share of the references' variance that the curve explains; none where there is no variance.
    pub r_squared: Option<f64>,
    /// Whether the curve never falls on the values of t there are, nor up to t = 3.
    pub rises: bool,
    /// Whether it never passes 1 there.
    pub bounded: bool,
    /// The mean of the pairs' PSNRs over all channels, dB: of this fit, of the family's own constants, of AP3.
    pub psnr: Scores,
}

/// The same score of three curves.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Scores {
    /// The fitted constants.
    pub fitted: f64,
    /// The constants in the family's row.
    pub frozen: f64,
    /// AP3 with its own.
    pub ap3: f64,
}

impl Scores {
    /// The scores of the fitted settings, of their family and of AP3.
    fn of(settings: &ToneSettings, score: impl Fn(&ToneSettings) -> f64) -> Self {
        Self {
            fitted: score(settings),
            frozen: score(&ToneSettings::new(settings.curve)),
            ap3: score(&ToneSettings::new(ToneCurve::Ap3)),
        }
    }

    /// The mean of each.
    fn mean<'a>(scores: impl Iterator<Item = &'a Self> + Clone) -> Self {
        let mean = |score: fn(&Self) -> f64| {
            scores.clone().map(score).sum::<f64>() / scores.clone().count() as f64
        };
        Self { fitted: mean(|s| s.fitted), frozen: mean(|s| s.frozen), ap3: mean(|s| s.ap3) }
    }
}

/// The mean of the pairs' PSNRs over all channels, dB.
fn mean_psnr(settings: &ToneSettings, pairs: &[&Pair]) -> f64 {
    pairs.iter().map(|pair| psnr(settings, pair)).sum::<f64>() / pairs.len() as f64
}

/// The mean over the pairs of their mean squared errors.
fn mean_squared_error(settings: &ToneSettings, pairs: &[&Pair]) -> f64 {
    let error = |pair: &&Pair| 10f64.powf(-0.1 * psnr(settings, pair));
    pairs.iter().map(error).sum::<f64>() / pairs.len() as f64
}

/// Fits the family's constants to the pairs: for curves that adapt to a photograph also black level (alpha) and gain
/// (c, g0), for those that scale by a mean its aim theta.
///
/// # Errors
/// [`Error::Usage`] where the options make no sense or the family has nothing to fit; [`Error::Input`] where the pairs
/// hold fewer different values than there are constants.
pub fn fit(family: &'static Family, pairs: &[&Pair], options: &FitOptions) -> Result<Fit> {
    options.check()?;
    let model = Model::new(family, options)?;
    let Some(first) = pairs.first() else {
        return Err(Error::Usage("there are no pairs to fit to".to_owned()));
    };
    let mut solver = Solver::new(&model, pairs, options);
    let (columns, needed) = (
        solver.groups.iter().map(|group| group.histogram.columns.len()).sum::<usize>(),
        model.free.len(),
    );
    if columns < needed {
        let problem = format!(
            "all pairs together hold {columns} different values of t, too few for the {needed} constants of `{}`; \
             take photographs that are not of one colour",
            family.name
        );
        return Err(Error::input(&first.path, problem));
    }
    let solution = solver.solve();
    let settings = model.settings(&solution.values);
    settings.check()?;

    let residuals = Residuals::of(&model, &solution, pairs, options.channels);
    let mut sizes = solver.sizes(&solution.values);
    let limit = solution.delta.unwrap_or(f64::INFINITY);
    let huber_loss =
        |size: f64| if size <= limit { 0.5 * size * size } else { limit * (size - 0.5 * limit) };
    let robust_loss =
        sizes.iter().map(|(size, count)| count * huber_loss(*size)).sum::<f64>() / residuals.count;
    let confidence = confidence::of(&model, &solver.groups, &solution, &residuals);
    Ok(Fit {
        constants: confidence.estimates,
        values: residuals.count,
        effective_values: confidence.effective_values,
        rmse: (residuals.squares / residuals.count).sqrt(),
        residual_quantiles: [0.5, 0.95].map(|share| quantile(&mut sizes, share)),
        huber_delta: solution.delta,
        robust_loss,
        r_squared: (residuals.variance > 1e-12)
            .then(|| 1.0 - residuals.squares / residuals.count / residuals.variance),
        rises: solution.rises,
        bounded: solution.bounded,
        psnr: Scores::of(&settings, |settings| mean_psnr(settings, pairs)),
        settings,
    })
}

/// What is left of the references, pair by pair.
struct Residuals {
    count: f64,
    squares: f64,
    /// The same, each pair times its weight.
    weighted_squares: f64,
    /// Of the reference values.
    variance: f64,
    /// Of each pair, how many values it has and the mean of its residuals times the root of its weight.
    means: Vec<(f64, f64)>,
}

impl Residuals {
    fn of(model: &Model, solution: &Solution, pairs: &[&Pair], channels: Channels) -> Self {
        let (mut count, mut squares, mut weighted_squares, mut means) = (0.0, 0.0, 0.0, vec![]);
        let [mut sum_y, mut sum_y2] = [0.0; 2];
        for (pair, weight) in pairs.iter().zip(&solution.weights) {
            let (of_pair, sums) = pair_residuals(model, &solution.values, pair, channels);
            count += of_pair;
            squares += sums[1];
            weighted_squares += weight * sums[1];
            means.push((of_pair, weight.sqrt() * sums[0] / of_pair));
            let histograms = parts(model, pair, channels).into_iter().flat_map(|(_, parts)| parts);
            for column in histograms.flat_map(|histogram| &histogram.columns) {
                sum_y += column.sum_y;
                sum_y2 += column.sum_y2;
            }
        }
        let variance = sum_y2 / count - (sum_y / count).powi(2);
        Self { count, squares: squares.max(0.0), weighted_squares, variance, means }
    }
}
