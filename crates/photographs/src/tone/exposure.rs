//! The brightness of targets: a gain for each photograph, chosen from all of a scene.
//!
//! ```text
//! ln k_v     = s ln gain(view) + (1 - s) around(view)                    gain: see `metering`
//! around(v)  = sum_w a_vw ln gain(w) / sum_w a_vw            a_vw = exp(-|p_v - p_w|^2 / (2 h^2)), h = 0.15
//! s          = tau^2 / (tau^2 + 0.1^2)
//! brightening = mean soft(Y; k) / mean Y, over the scene
//! ```
//!
//! p is a camera's position, in units of the standard deviation of all positions, together with its viewing direction;
//! tau is the root mean square of ln gain(v) - around(v) over the views. So views of the same content have consistent
//! targets, unless their exposures differ. If the cameras are unknown, ln gain(scene) replaces around(v), and s is
//! max(0.75, sigma^2 / (sigma^2 + 0.1^2)), with sigma the standard deviation of ln gain over the views.
//!
//! A camera's night mode leaves some photographs dark and others lit. If a wide gap separates them, the lit ones are
//! their own targets, and the dark ones get the same mean luminance.

use nightsplat_core::camera::{Camera, CameraPoses};
use serde::{Deserialize, Serialize};

use super::histogram::LuminanceHistogram;
use super::metering::{BLACK_SKY, CurveEnds, MAX_GAIN, Metering, gain_at, mean_of_soft};

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

/// A gap of brightenings of at least this factor separates lit photographs from dark ones.
const LIT_GAP: f64 = 2.5;

/// The fewest photographs on either side of the gap.
const MIN_GROUP: usize = 2;

/// Minimum and maximum of the mean luminance that lit photographs set for the dark ones.
const LIT_MEANS: [f64; 2] = [0.35, 0.6];

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
    /// The number of photographs among dark ones that are well lit, and their own targets.
    pub lit: usize,
    /// The mean share of a photograph that is black sky, without shadows.
    pub sky: f64,
    /// How the curve reaches white and leaves black.
    pub ends: CurveEnds,
    metering: Metering,
    /// The brightening below which a photograph is lit, if there are lit and dark ones.
    lit_below: Option<f64>,
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
        let (black, seen): (Vec<_>, Vec<_>) = views.into_iter().partition(|view| is_black(view));
        let lit_below = if brightness.is_some() { None } else { lit_below(&seen) };
        let is_lit = |view: &&LuminanceHistogram| is_lit(view, lit_below);
        let (lit, dark): (Vec<_>, Vec<_>) = seen.into_iter().partition(is_lit);
        if dark.is_empty() {
            return None;
        }
        let pool = pooled(&dark);
        let mut metering = Metering::new(&dark, &pool, brightness);
        if !lit.is_empty() {
            let lit_mean = pooled(&lit).mean().clamp(LIT_MEANS[0], LIT_MEANS[1]);
            metering.ln_factor = (gain_at(&pool, lit_mean) / metering.gain_of(&pool)).ln();
        }
        let gains: Vec<f64> = dark.iter().map(|view| metering.gain_of(view).ln()).collect();
        let mean_gain = gains.iter().sum::<f64>() / gains.len() as f64;
        let squares = gains.iter().map(|gain| (gain - mean_gain).powi(2));
        let variance = squares.sum::<f64>() / gains.len() as f64;
        let gain = metering.gain_of(&pool);
        let ends = metering.ends(&pool, gain);
        Some(Self {
            gain,
            target: pool.mean_of(|y| ends.soft(y, gain)),
            mean: pool.mean(),
            spread: variance.sqrt(),
            share: share_without_cameras(variance),
            black: black.len(),
            lit: lit.len(),
            sky: metering.sky,
            ends,
            metering,
            lit_below,
            around: None,
        })
    }

    /// [`Exposure::measure`] with the cameras of the training photographs.
    #[must_use]
    pub fn seen_by<'a>(
        self,
        views: impl IntoIterator<Item = (&'a LuminanceHistogram, Camera)>,
    ) -> Self {
        let dark = views.into_iter().filter(|(view, _)| !is_black(view) && !self.is_lit(view));
        let (gains, cameras): (Vec<f64>, Vec<Camera>) =
            dark.map(|(view, camera)| (self.metering.gain_of(view).ln(), camera)).unzip();
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

    /// Sets the requested brightness, which files of exposures lack.
    pub fn request(&mut self, brightness: Option<f64>) {
        self.metering.brightness = brightness;
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
        let ln_gain = self.metering.gain_of(view).ln();
        let (share, other) = match (&self.around, camera) {
            (Some(around), Some(camera)) => (around.own_share, around.ln_gain(camera)),
            (Some(_), None) => (share_without_cameras(self.spread.powi(2)), self.gain.ln()),
            (None, _) => (self.share, self.gain.ln()),
        };
        (share * ln_gain + (1.0 - share) * other).exp()
    }

    /// Whether a photograph is its own target, as others are dark.
    pub fn is_lit(&self, view: &LuminanceHistogram) -> bool {
        is_lit(view, self.lit_below)
    }

    /// k of what a camera sees, without a photograph of it: the mean of its neighbours, or the scene's.
    pub fn gain_around(&self, camera: &Camera) -> f64 {
        self.around.as_ref().map_or(self.gain, |around| around.ln_gain(camera).exp())
    }

    /// Whether so much is black sky that the model leaves it open.
    pub fn has_black_sky(&self) -> bool {
        self.sky >= BLACK_SKY
    }

    /// The mean brightness of the targets over that of the photographs.
    pub fn brightening(&self) -> f64 {
        self.target / self.mean
    }

    /// The weight of the curve relative to the unchanged photograph: 0 for a well-lit set, 1 for a dark one or with a
    /// requested brightness.
    pub fn weight(&self) -> f64 {
        let [none, whole] = WELL_LIT;
        if self.metering.brightness.is_some() {
            1.0
        } else {
            ((self.brightening() - none) / (whole - none)).clamp(0.0, 1.0)
        }
    }

    /// The result and its reason, in a sentence.
    pub fn reason(&self) -> String {
        let Self { gain, target, mean, spread, black, lit, .. } = self;
        let brightening = self.brightening();
        let verdict = match self.weight() {
            0.0 => "well lit, no curve".to_owned(),
            1.0 if *gain > 0.999 * MAX_GAIN => format!(
                "gain {gain:.1}, its limit (if 16-bit files hold linear light, say `--light linear`)"
            ),
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
        let lit = match lit {
            0 => String::new(),
            count => format!("; {count} well lit, their own targets"),
        };
        format!(
            "mean luminance {mean:.3}, {brightening:.1} times that is {target:.2}: {verdict}{varies}{left_out}{lit}"
        )
    }
}

/// The values from which values at one gain are interpolated to another, at this weight of a curve with these ends;
/// ascending.
pub fn exposure_knots(ends: &CurveEnds, [from, to]: [f64; 2], weight: f64) -> Vec<[f32; 2]> {
    const KNOTS: u32 = 1024;
    // Evenly spaced in the output of the curve, up to its white.
    let knot = |i: u32| {
        let x = -(1.0 - f64::from(i) / f64::from(KNOTS + 1)).ln() / from.min(to);
        [from, to].map(|gain| ((1.0 - weight) * x.min(1.0) + weight * ends.soft(x, gain)) as f32)
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
    #[serde(default)]
    lit: usize,
    #[serde(default)]
    sky: f64,
    #[serde(default)]
    ends: CurveEnds,
    reason: String,
}

impl From<SerializedExposure> for Exposure {
    fn from(written: SerializedExposure) -> Self {
        let SerializedExposure { gain, target, mean, spread, share, black, lit, sky, ends, .. } =
            written;
        let metering = Metering::default();
        Self {
            gain,
            target,
            mean,
            spread,
            share,
            black,
            lit,
            sky,
            ends,
            metering,
            lit_below: None,
            around: None,
        }
    }
}

impl From<Exposure> for SerializedExposure {
    fn from(exposure: Exposure) -> Self {
        let (brightening, weight, reason) =
            (exposure.brightening(), exposure.weight(), exposure.reason());
        let Exposure { gain, target, mean, spread, share, black, lit, sky, ends, .. } = exposure;
        Self {
            gain,
            target,
            mean,
            brightening,
            weight,
            spread,
            share,
            black,
            lit,
            sky,
            ends,
            reason,
        }
    }
}

/// The error if every photograph is black.
pub fn all_black(path: &std::path::Path) -> nightsplat_core::Error {
    let problem = "every photograph is almost black (99 % of its pixels are below 2 of 255); expose longer, name a \
                   curve with --curve, or say `--light linear` if 16-bit files hold linear light";
    nightsplat_core::Error::input(path, problem)
}

/// The weight of a view's own gain relative to the scene's, from the variance of ln gain over the views.
fn share_without_cameras(variance: f64) -> f64 {
    MIN_SHARE.max(variance / (variance + NOISE * NOISE))
}

/// Whether a photograph is almost black.
pub fn is_black(view: &LuminanceHistogram) -> bool {
    view.quantile(0.99) < BLACK
}

/// The brightening of a photograph that is metered by itself.
fn brightening(view: &LuminanceHistogram) -> f64 {
    mean_of_soft(view, Metering::default().gain_of(view)) / view.mean()
}

fn is_lit(view: &LuminanceHistogram, lit_below: Option<f64>) -> bool {
    lit_below.is_some_and(|below| brightening(view) < below)
}

/// The brightening in the middle of the widest gap, if it separates lit photographs from dark ones.
fn lit_below(views: &[&LuminanceHistogram]) -> Option<f64> {
    let mut brightenings: Vec<f64> = views.iter().map(|view| brightening(view)).collect();
    brightenings.sort_by(f64::total_cmp);
    let last = brightenings.len().checked_sub(MIN_GROUP)?;
    let gap = |&at: &usize| brightenings[at] / brightenings[at - 1];
    let at = (MIN_GROUP..=last).max_by(|a, b| gap(a).total_cmp(&gap(b)))?;
    let [lit, dark] = [brightenings[at - 1], brightenings[at]];
    (dark >= LIT_GAP * lit && lit < WELL_LIT[0] && dark >= WELL_LIT[1]).then(|| (lit * dark).sqrt())
}

fn pooled(views: &[&LuminanceHistogram]) -> LuminanceHistogram {
    let mut pool = LuminanceHistogram::default();
    views.iter().for_each(|view| pool.add(view));
    pool
}
