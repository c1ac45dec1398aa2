//! The constants of a tone curve from pairs of photographs, one dark and one in normal light.
//!
//! The model is y = f(t), t = x / p90 of each photograph, y the reference value; least squares over all pixels:
//!
//! ```text
//! pairs -> joint histogram of (t, y) -> Levenberg-Marquardt on its columns, reweighted after Huber -> constants
//! ```
//!
//! A column of the histogram contains all pixels of one t, so the cost of a fit does not depend on their number. Bounds
//! are satisfied by construction (each constant is a logistic function of an unbounded unknown), monotonicity by a
//! penalty that grows until it is satisfied. Residuals beyond `huber` times their scale (1.4826 times their median
//! magnitude) are weighted down in proportion (Huber 1964). [`Weighting`] sets the weights of photographs.
//!
//! Standard errors are those of Huber's estimator (Huber 1973) for an effective number of values: errors of pixels in
//! one photograph are correlated, and with their intraclass correlation rho, from the photographs' mean residuals, N
//! values in groups of m are equivalent to N / (1 + (m - 1) rho) independent ones. This assumes that photographs are
//! independent, that the model is correct, and that errors differ between photographs only by a shift; for a single
//! photograph, rho is unknown and taken as 0.

mod confidence;
mod histogram;
mod model;
mod pairs;
mod profile;
mod solve;
mod validate;

use std::borrow::Cow;

use nightsplat_core::{Error, Result};
use nightsplat_photographs::tone::{Tone, ToneCurve, ToneSettings};
use serde::Serialize;

pub use self::histogram::{Histogram, HistogramCell, HistogramColumn};
use self::model::FitModel;
pub use self::model::psnr;
pub use self::pairs::{FitScene, Pair, PairScene};
pub use self::profile::{
    ColourPair, ColourScene, ProfileFold, ProfileScores, cross_validate_profile, fit_profile,
    profile_scores,
};
use self::solve::{Solution, Solver, pair_residuals, parts, quantile};
pub use self::validate::{Fold, HeldOut, cross_validate};

/// The values of a photograph that are fitted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Channels {
    /// Red, green and blue as separate values, as the curve is applied.
    #[default]
    Rgb,
    /// The luminance.
    Luminance,
}

/// The weights of photographs in a fit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Weighting {
    /// Every pixel has the same weight: the least mean squared error.
    #[default]
    Pixels,
    /// The inverse of the photograph's mean squared residual, found together with the constants: the maximum likelihood
    /// if photographs differ in their distance from any curve. There may be several such fits, each close to some of
    /// the photographs.
    Photographs,
}

/// Options of a fit.
#[derive(Clone, Copy, Debug)]
pub struct FitOptions {
    /// The fitted values.
    pub channels: Channels,
    /// The weights of photographs.
    pub weighting: Weighting,
    /// Weight of the family's own constants, as a number of photographs: the fit is drawn towards them, less so with
    /// more pairs.
    pub prior: f64,
    /// Residuals beyond this many times their scale are weighted down; infinite for plain least squares.
    pub huber: f64,
    /// Columns of the histogram.
    pub bins: usize,
    /// Whether the curve must stay at or below 1 everywhere.
    pub bounded: bool,
    /// Whether black level and gain, alpha and c, are fitted with the constants of a family of t.
    pub adapt: bool,
}

impl Default for FitOptions {
    /// 1.345 is Huber's value for 95 % efficiency if errors are normal.
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
        // Written so that a NaN fails.
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
    pub name: Cow<'static, str>,
    /// Its value.
    pub value: f64,
    /// Its standard error; `None` at a bound, or if the pairs do not determine each constant.
    pub standard_error: Option<f64>,
    /// Whether it is at one of its bounds.
    pub at_bound: bool,
}

/// A curve fitted to pairs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CurveFit {
    /// The curve with the fitted constants, for `--curve`.
    pub settings: ToneSettings,
    /// The fitted constants.
    pub constants: Vec<Estimate>,
    /// The number of fitted values: pixels times channels.
    pub values: f64,
    /// The equivalent number of independent values.
    pub effective_values: f64,
    /// Root mean squared residual, for values in [0, 1].
    pub rmse: f64,
    /// The median and the 95th percentile of the residuals' magnitudes, with the photographs' weights.
    pub residual_quantiles: [f64; 2],
    /// The residual beyond which weights decrease; `None` without robust weights.
    pub huber_delta: Option<f64>,
    /// The mean Huber loss with the photographs' weights; without robust weights, half the mean square.
    pub robust_loss: f64,
    /// The share of the references' variance that the curve explains; `None` if they have no variance.
    pub r_squared: Option<f64>,
    /// Whether the curve never falls, over the pairs' range of t and up to t = 3.
    pub rises: bool,
    /// Whether it never exceeds 1 in that range.
    pub bounded: bool,
    /// The mean PSNR of the pairs over all channels, dB: for this fit, for the family's own constants, and for AP3.
    pub psnr: CurveScores,
}

/// A score of three curves.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CurveScores {
    /// With the fitted constants.
    pub fitted: f64,
    /// With the curve's own constants; those of a formula without a value are 1.
    pub frozen: f64,
    /// Of AP3 with its own constants.
    pub ap3: f64,
}

impl CurveScores {
    /// The scores of the fitted settings, of their family and of AP3.
    fn new(settings: &ToneSettings, score: impl Fn(&ToneSettings) -> f64) -> Self {
        Self {
            fitted: score(settings),
            frozen: score(&model::own_settings(&settings.curve)),
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

/// The mean PSNR of the pairs over all channels, dB.
fn mean_psnr(settings: &ToneSettings, pairs: &[&Pair]) -> f64 {
    pairs.iter().map(|pair| psnr(settings, pair)).sum::<f64>() / pairs.len() as f64
}

/// The mean over the pairs of their mean squared errors.
fn mean_squared_error(settings: &ToneSettings, pairs: &[&Pair]) -> f64 {
    let error = |pair: &&Pair| 10f64.powf(-0.1 * psnr(settings, pair));
    pairs.iter().map(error).sum::<f64>() / pairs.len() as f64
}

/// Fits the curve's constants to the pairs; for curves that adapt to a photograph, also black level (alpha) and gain
/// (c, g0); for those that scale by a mean, also the target mean theta.
pub fn fit(curve: &Tone, pairs: &[&Pair], options: &FitOptions) -> Result<CurveFit> {
    options.check()?;
    let model = FitModel::new(curve, options)?;
    let Some(first) = pairs.first() else {
        return Err(Error::Usage("there are no pairs to fit to".to_owned()));
    };
    let mut solver = Solver::new(&model, pairs, options);
    let columns: usize = solver.groups.iter().map(|group| group.histogram.columns.len()).sum();
    let needed = model.free.len();
    if columns < needed {
        let problem = format!(
            "all pairs together have {columns} different values of t, too few for the {needed} constants of \
             `{curve}`; take photographs that are not of one colour"
        );
        return Err(Error::input(&first.path, problem));
    }
    let solution = solver.solve();
    let settings = model.settings(&solution.values);
    settings.check()?;

    let residuals = Residuals::new(&model, &solution, pairs, options.channels);
    let mut sizes = solver.sizes(&solution.values);
    let limit = solution.delta.unwrap_or(f64::INFINITY);
    let huber_loss =
        |size: f64| if size <= limit { 0.5 * size * size } else { limit * (size - 0.5 * limit) };
    let robust_loss =
        sizes.iter().map(|(size, count)| count * huber_loss(*size)).sum::<f64>() / residuals.count;
    let confidence = confidence::estimate(&model, &solver.groups, &solution, &residuals);
    Ok(CurveFit {
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
        psnr: CurveScores::new(&settings, |settings| mean_psnr(settings, pairs)),
        settings,
    })
}

/// The residuals of the references, pair by pair.
struct Residuals {
    count: f64,
    squares: f64,
    /// Squared residuals, each pair times its weight.
    weighted_squares: f64,
    /// Variance of the reference values.
    variance: f64,
    /// For each pair, its number of values, and its mean residual times the root of its weight.
    means: Vec<(f64, f64)>,
}

impl Residuals {
    fn new(model: &FitModel, solution: &Solution, pairs: &[&Pair], channels: Channels) -> Self {
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
