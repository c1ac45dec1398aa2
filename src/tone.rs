//! Tone curves: a dark photograph in, the pseudo-GT that training aims at out.
//!
//! Every curve acts on sRGB-encoded values as stored, divided by 255, without linearisation:
//!
//! ```text
//! none    x
//! linear  x theta / mean(x)
//! ASE     delta0 + (1 - delta0) (1 - exp(-g t))              g = g0 + c Y
//! AP3     delta0 + b (0.0720 t^3 - 0.4376 t^2 + 0.9948 t)    b = 1 + c Y
//! ```
//!
//! clamped to [0, 1], where t = x / p90, Y is the mean luminance, and the black level
//! delta0 = alpha (1 - p10 / p90)^beta is high where shadows are crushed. The statistics are those of
//! one photograph, see [`Statistics`].

mod statistics;

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

pub(crate) use self::statistics::Rank;
pub use self::statistics::{Statistics, percentile};
pub use crate::kernels::ToneParameters;
use crate::reference::tone;
use crate::{Error, Result};

/// The least value that linear scaling maps to 1: it keeps a black photograph black.
const LEAST_WHITE: f64 = 1e-12;

/// A family of tone curves, by the name the command line and the run directory use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ToneCurve {
    /// The photograph as it is.
    None,
    /// One gain for all values: the mean becomes theta, bright values clip.
    Linear,
    /// Adaptive soft exponential: bounded, concave.
    Ase,
    /// Adaptive cubic: nearly proportional in the shadows, rolls off above p90.
    Ap3,
}

impl ToneCurve {
    /// Every curve, in the order that help texts list them.
    pub const ALL: [Self; 4] = [Self::Linear, Self::Ase, Self::Ap3, Self::None];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Linear => "linear",
            Self::Ase => "ase",
            Self::Ap3 => "ap3",
        }
    }

    /// The curve's number in `include/tone.glsl`: the specialization constant `TONE_CURVE`.
    pub fn constant(self) -> u32 {
        match self {
            Self::None => tone::CURVE_NONE,
            Self::Linear => tone::CURVE_LINEAR,
            Self::Ase => tone::CURVE_ASE,
            Self::Ap3 => tone::CURVE_AP3,
        }
    }

    /// The curve at t = x / white, in [0, 1], as exact as f64 allows; a NaN becomes 0.
    pub fn value(self, t: f64, offset: f64, gain: f64) -> f64 {
        let y = match self {
            Self::None | Self::Linear => t,
            Self::Ase => offset - (1.0 - offset) * (-gain * t).exp_m1(),
            Self::Ap3 => offset + gain * (((0.0720 * t - 0.4376) * t + 0.9948) * t),
        };
        if y > 0.0 { y.min(1.0) } else { 0.0 }
    }

    /// The curve at the sRGB-encoded value `x`, in the arithmetic of the kernels.
    pub fn apply(self, x: f32, parameters: &ToneParameters) -> f32 {
        tone::tone_curve(self.constant(), x, parameters)
    }
}

impl fmt::Display for ToneCurve {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for ToneCurve {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|curve| curve.name() == name).ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            Error::Usage(format!("unknown curve `{name}`; the curves are {names}"))
        })
    }
}

/// A curve and its constants; what a photograph adds to them are its [`Statistics`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ToneSettings {
    /// The family.
    pub curve: ToneCurve,
    /// c: how much a brighter photograph raises the gain of ASE and AP3.
    pub gain_c: f64,
    /// theta: the mean over all channels that the linear curve aims at, before clipping.
    pub theta: f64,
    /// alpha: the highest black level.
    pub alpha: f64,
    /// beta: how fast the black level falls as p10 approaches p90; 0: it is alpha for every photograph.
    pub beta: f64,
    /// g0: the gain of ASE on a black photograph.
    pub base_gain: f64,
}

impl ToneSettings {
    /// The paper's constants for LOM; c is 3 for ASE and 1 for AP3.
    pub fn new(curve: ToneCurve) -> Self {
        let gain_c = match curve {
            ToneCurve::Ase => 3.0,
            ToneCurve::Ap3 => 1.0,
            ToneCurve::None | ToneCurve::Linear => 0.0,
        };
        Self { curve, gain_c, theta: 0.49, alpha: 0.12, beta: 2.5, base_gain: 1.0 }
    }

    /// Refuses constants that leave a curve undefined, decreasing or above white at black.
    pub fn check(&self) -> Result<()> {
        let rules = [
            ("--gain (c)", self.gain_c, self.gain_c >= 0.0, "at least 0"),
            ("--theta", self.theta, self.theta > 0.0, "above 0"),
            ("alpha", self.alpha, (0.0..=1.0).contains(&self.alpha), "from 0 to 1"),
            ("beta", self.beta, self.beta >= 0.0, "at least 0"),
            ("base_gain (g0)", self.base_gain, self.base_gain > 0.0, "above 0"),
        ];
        for (name, value, holds, rule) in rules {
            if !(holds && (value as f32).is_finite()) {
                return Err(Error::Usage(format!(
                    "{name} is {value}; it must be finite and {rule}"
                )));
            }
        }
        Ok(())
    }

    /// delta0 = alpha (1 - r)^beta: the black level of a photograph with r = p10 / p90.
    pub fn offset(&self, ratio: f64) -> f64 {
        self.alpha * (1.0 - ratio).powf(self.beta)
    }

    /// The curve that these settings give a photograph with these statistics.
    pub fn parameters(&self, statistics: &Statistics) -> ToneParameters {
        let gain = |base: f64| base + self.gain_c * f64::from(statistics.mean_luminance);
        let p90 = f64::from(statistics.p90);
        let offset = self.offset(statistics.ratio());
        let (white, offset, gain) = match self.curve {
            ToneCurve::None => (1.0, 0.0, 1.0),
            ToneCurve::Linear => {
                ((f64::from(statistics.mean) / self.theta).max(LEAST_WHITE), 0.0, 1.0)
            }
            ToneCurve::Ase => (p90, offset, gain(self.base_gain)),
            ToneCurve::Ap3 => (p90, offset, gain(1.0)),
        };
        ToneParameters { white: white as f32, offset: offset as f32, gain: gain as f32 }
    }
}

impl Default for ToneSettings {
    fn default() -> Self {
        Self::new(ToneCurve::Ap3)
    }
}
