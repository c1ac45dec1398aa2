//! The brightness of targets: a gain chosen from the luminance of dark photographs.
//!
//! ```text
//! soft(x; k) = delta + (1 - delta) (1 - exp(-k x))                       delta = 0.075
//! gain(H)    k = 0.90 / (mean W^3)^(1/3), W = min(Y, 99.9 % quantile of Y)
//!            within the gains at which the mean of soft(Y; k) is 0.44 and 0.54, at most 128
//! ln k_v     = s ln gain(view) + (1 - s) around(view)
//! around(v)  = sum_w a_vw ln gain(w) / sum_w a_vw            a_vw = exp(-|p_v - p_w|^2 / (2 h^2)), h = 0.15
//! s          = tau^2 / (tau^2 + 0.1^2)
//! brightening = mean soft(Y; k) / mean Y, over the scene
//! ```
//!
//! H is the histogram of the encoded luminance Y of one photograph, or of all training photographs together. p is a
//! camera's position, in units of the standard deviation of all positions, together with its viewing direction; tau is
//! the root mean square of ln gain(v) - around(v) over the views. So views of the same content have consistent targets,
//! unless their exposures differ. If the cameras are unknown, ln gain(scene) replaces around(v), and s is max(0.75,
//! sigma^2 / (sigma^2 + 0.1^2)), with sigma the standard deviation of ln gain over the views. A cubic mean is between
//! average metering (power 1) and metering for the highlights (infinity): a scene of high contrast gets less exposure,
//! as a photographer would choose. Lamps and windows make it unbounded, so the mean is limited (18 % grey is 0.46 when
//! encoded). Power and constants were chosen on pairs of low- and normal-light photographs (LOL, LOM, `RealX3D`).

use serde::{Deserialize, Serialize};

use super::histogram::LuminanceHistogram;
use super::real::Real;
use crate::camera::{Camera, CameraPoses};

/// The black level of [`soft`].
pub(super) const BLACK_LEVEL: f64 = 0.075;

/// The cubic mean of the luminance times the gain.
const CUBIC_MEAN: f64 = 0.90;

/// Minimum and maximum of a target's mean luminance.
const MEANS: [f64; 2] = [0.44, 0.54];

/// Minimum and maximum of the gain.
const GAINS: [f64; 2] = [1e-3, MAX_GAIN];

/// The largest gain.
pub(crate) const MAX_GAIN: f64 = 128.0;

/// The minimum weight of a view's own gain if cameras are unknown.
const MIN_SHARE: f64 = 0.75;

/// The spread of ln gain, between all views or neighbouring ones, at which views' own gains have half the weight.
const NOISE: f64 = 0.1;

/// h: the distance of cameras whose views have similar gains.
const REACH: f64 = 0.15;

/// In a larger scene, only this many cameras, evenly spread in the list, are used as neighbours: the time is then
/// linear in the number of photographs.
const MAX_POSES: usize = 1024;

/// Up to the first brightening, photographs are left unchanged; from the second on, the curve has full weight.
const WELL_LIT: [f64; 2] = [1.5, 2.0];

/// A photograph whose 99 % quantile is lower is almost black: two 8-bit code values.
const BLACK: f64 = 2.0 / 255.0;

/// delta + (1 - delta) (1 - exp(-k x)): the curve to which the rule applies.
pub fn soft(x: f64, gain: f64) -> f64 {
    BLACK_LEVEL + (1.0 - BLACK_LEVEL) * (gain * x).one_minus_exp()
}

/// The exposure of a set of photographs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(into = "SerializedExposure", from = "SerializedExposure")]
pub struct Exposure {
    /// The gain of all training photographs together, except black ones.
    pub gain: f64,
    /// The mean luminance of the targets at that gain.
    pub target: f64,
    /// The mean luminance of the photographs.
    pub mean: f64,
    /// sigma: the standard deviation of ln gain over the views.
    pub spread: f64,
    /// How much of the differences between the views' own gains remains in the gains of their targets: the slope of ln
    /// k.
    pub share: f64,
    /// The number of almost black photographs.
    pub black: usize,
    /// The requested mean luminance, in place of the rule's.
    pub(crate) brightness: Option<f64>,
    /// The gains of views by their cameras, if known.
    around: Option<NeighbourGains>,
}

/// Gains by camera.
#[derive(Clone, Debug, PartialEq)]
struct NeighbourGains {
    poses: CameraPoses,
    /// ln gain of each camera.
    gains: Vec<f64>,
    /// s: the weight of a view's own gain.
    own_share: f64,
}

impl NeighbourGains {
    /// around(v): the mean of ln gain over the cameras near this one; the nearest always counts.
    fn ln_gain(&self, camera: &Camera) -> f64 {
        let squares: Vec<f64> = self.poses.squared_distances(camera).collect();
        let nearest = squares.iter().copied().fold(f64::INFINITY, f64::min);
        let weight = |square: &f64| (-(square - nearest) / (2.0 * REACH * REACH)).exp();
        let weights: Vec<f64> = squares.iter().map(weight).collect();
        let sum: f64 = weights.iter().zip(&self.gains).map(|(weight, gain)| weight * gain).sum();
        sum / weights.iter().sum::<f64>()
    }
}

impl Exposure {
    /// The exposure of a set, from the luminance of its training photographs. `brightness` is the mean luminance of the
    /// targets, instead of the rule's. `None` if every photograph is almost black.
    pub fn measure<'a>(
        views: impl IntoIterator<Item = &'a LuminanceHistogram>,
        brightness: Option<f64>,
    ) -> Option<Self> {
        let (mut pool, mut gains, mut black) = (LuminanceHistogram::default(), vec![], 0);
        for view in views {
            if is_black(view) {
                black += 1;
                continue;
            }
            pool.add(view);
            gains.push(gain_of(view, brightness).ln());
        }
        if gains.is_empty() {
            return None;
        }
        let mean_gain = gains.iter().sum::<f64>() / gains.len() as f64;
        let squares = gains.iter().map(|gain| (gain - mean_gain).powi(2));
        let variance = squares.sum::<f64>() / gains.len() as f64;
        let gain = gain_of(&pool, brightness);
        Some(Self {
            gain,
            target: mean_of_soft(&pool, gain),
            mean: pool.mean(),
            spread: variance.sqrt(),
            share: share_without_cameras(variance),
            black,
            brightness,
            around: None,
        })
    }

    /// [`Exposure::measure`] with the cameras of the training photographs.
    #[must_use]
    pub fn seen_by<'a>(
        self,
        views: impl IntoIterator<Item = (&'a LuminanceHistogram, Camera)>,
    ) -> Self {
        let lit = views.into_iter().filter(|(view, _)| !is_black(view));
        let (gains, cameras): (Vec<f64>, Vec<Camera>) =
            lit.map(|(view, camera)| (gain_of(view, self.brightness).ln(), camera)).unzip();
        if gains.is_empty() {
            return self;
        }
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        let every = gains.len().div_ceil(MAX_POSES);
        let (poses, at) =
            (CameraPoses::new(&cameras), gains.iter().step_by(every).copied().collect());
        let mut around = NeighbourGains { poses: poses.every(every), gains: at, own_share: 0.0 };
        let smooth: Vec<f64> = cameras.iter().map(|camera| around.ln_gain(camera)).collect();
        let squares = gains.iter().zip(&smooth).map(|(gain, smooth)| (gain - smooth).powi(2));
        let variance = mean(&squares.collect::<Vec<_>>());
        around.own_share = variance / (variance + NOISE * NOISE);
        // The slope of ln k over ln gain.
        let middle = mean(&gains);
        let (mut products, mut squares) = (0.0, 0.0);
        for (gain, smooth) in gains.iter().zip(&smooth) {
            let used = around.own_share * gain + (1.0 - around.own_share) * smooth;
            products += (used - middle) * (gain - middle);
            squares += (gain - middle).powi(2);
        }
        let share = if squares > 0.0 { products / squares } else { self.share };
        Self { share: share.clamp(0.0, 1.0), around: Some(around), ..self }
    }

    /// The exposure with one gain for every photograph.
    #[must_use]
    pub fn shared(self) -> Self {
        Self { share: 0.0, around: None, ..self }
    }

    /// k of any photograph of the scene, with its camera if known; one that is almost black has the scene's gain.
    pub fn gain_of(&self, view: &LuminanceHistogram, camera: Option<&Camera>) -> f64 {
        if is_black(view) {
            return self.gain;
        }
        let ln_gain = gain_of(view, self.brightness).ln();
        let (share, other) = match (&self.around, camera) {
            (Some(around), Some(camera)) => (around.own_share, around.ln_gain(camera)),
            (Some(_), None) => (share_without_cameras(self.spread.powi(2)), self.gain.ln()),
            (None, _) => (self.share, self.gain.ln()),
        };
        (share * ln_gain + (1.0 - share) * other).exp()
    }

    /// k of what a camera sees, without a photograph of it: the mean of its neighbours, or the scene's.
    pub(crate) fn gain_around(&self, camera: &Camera) -> f64 {
        self.around.as_ref().map_or(self.gain, |around| around.ln_gain(camera).exp())
    }

    /// The mean brightness of the targets over that of the photographs.
    pub fn brightening(&self) -> f64 {
        self.target / self.mean
    }

    /// The weight of the curve relative to the unchanged photograph: 0 for a well-lit set, 1 for a dark one or with a
    /// requested brightness.
    pub fn weight(&self) -> f64 {
        let [none, whole] = WELL_LIT;
        if self.brightness.is_some() {
            1.0
        } else {
            ((self.brightening() - none) / (whole - none)).clamp(0.0, 1.0)
        }
    }

    /// The result and its reason, in a sentence.
    pub fn reason(&self) -> String {
        let Self { gain, target, mean, spread, black, .. } = self;
        let brightening = self.brightening();
        let verdict = match self.weight() {
            0.0 => "well lit, no curve".to_owned(),
            1.0 => format!("gain {gain:.1}"),
            weight => format!("{:.0} % of a curve of gain {gain:.1}", 100.0 * weight),
        };
        let varies = match spread / std::f64::consts::LN_2 {
            stops if stops >= 0.1 => format!(", give or take {stops:.1} stops between the views"),
            _ => String::new(),
        };
        let left_out = match black {
            0 => String::new(),
            count => format!("; {count} almost black, left out of the measurement"),
        };
        format!(
            "mean luminance {mean:.3}, {brightening:.1} times that is {target:.2}: {verdict}{varies}{left_out}"
        )
    }
}

/// The values from which values at one gain are interpolated to another, at this weight of the curve; ascending.
pub fn exposure_knots([from, to]: [f64; 2], weight: f64) -> Vec<[f32; 2]> {
    const KNOTS: u32 = 1024;
    // Evenly spaced in the output of the curve, up to its white.
    let knot = |i: u32| {
        let x = -(1.0 - f64::from(i) / f64::from(KNOTS + 1)).ln() / from.min(to);
        [from, to].map(|gain| ((1.0 - weight) * x.min(1.0) + weight * soft(x, gain)) as f32)
    };
    (0..=KNOTS).map(knot).collect()
}

/// The exposure in files: neither the requested brightness, which is a setting, nor the gains by camera.
#[derive(Serialize, Deserialize)]
struct SerializedExposure {
    gain: f64,
    target: f64,
    mean: f64,
    brightening: f64,
    weight: f64,
    spread: f64,
    share: f64,
    black: usize,
    reason: String,
}

impl From<SerializedExposure> for Exposure {
    fn from(written: SerializedExposure) -> Self {
        let SerializedExposure { gain, target, mean, spread, share, black, .. } = written;
        Self { gain, target, mean, spread, share, black, brightness: None, around: None }
    }
}

impl From<Exposure> for SerializedExposure {
    fn from(exposure: Exposure) -> Self {
        let (brightening, weight, reason) =
            (exposure.brightening(), exposure.weight(), exposure.reason());
        let Exposure { gain, target, mean, spread, share, black, .. } = exposure;
        Self { gain, target, mean, brightening, weight, spread, share, black, reason }
    }
}

/// The error if every photograph is black.
pub(crate) fn all_black(path: &std::path::Path) -> crate::Error {
    let problem = "every photograph is almost black (99 % of its pixels are below 2 of 255); expose longer, or name \
                   a curve with --curve";
    crate::Error::input(path, problem)
}

/// The weight of a view's own gain relative to the scene's, from the variance of ln gain over the views.
fn share_without_cameras(variance: f64) -> f64 {
    MIN_SHARE.max(variance / (variance + NOISE * NOISE))
}

/// Whether a photograph is almost black.
pub fn is_black(view: &LuminanceHistogram) -> bool {
    view.quantile(0.99) < BLACK
}

/// gain(H), or the gain at which the mean luminance is `brightness`.
fn gain_of(luminance: &LuminanceHistogram, brightness: Option<f64>) -> f64 {
    if let Some(mean) = brightness {
        return gain_at(luminance, mean);
    }
    let gain = (CUBIC_MEAN / luminance.cubic_mean()).clamp(GAINS[0], GAINS[1]);
    match mean_of_soft(luminance, gain) {
        mean if mean < MEANS[0] => gain_at(luminance, MEANS[0]),
        mean if mean > MEANS[1] => gain_at(luminance, MEANS[1]),
        _ => gain,
    }
}

fn mean_of_soft(luminance: &LuminanceHistogram, gain: f64) -> f64 {
    luminance.mean_of(|y| soft(y, gain))
}

/// The gain at which the mean of the curve is `mean`.
fn gain_at(luminance: &LuminanceHistogram, mean: f64) -> f64 {
    solved(GAINS, |gain| mean_of_soft(luminance, gain) < mean)
}

/// The first strength within bounds that is not too low, by bisection of its logarithm; a bound if there is none.
pub(super) fn solved(bounds: [f64; 2], is_low: impl Fn(f64) -> bool) -> f64 {
    let [mut low, mut high] = bounds.map(f64::ln);
    for _ in 0..50 {
        let middle = 0.5 * (low + high);
        *(if is_low(middle.exp()) { &mut low } else { &mut high }) = middle;
    }
    (0.5 * (low + high)).exp()
}
