//! Tone curves: from a dark photograph to its pseudo-GT, the target of training.
//!
//! Every curve acts on sRGB-encoded values as stored, divided by 255, without linearisation:
//!
//! ```text
//! none    x
//! linear  x theta / mean(x)
//! ASE     delta0 + (1 - delta0) (1 - exp(-g t))              g = g0 + c Y
//! AP3     delta0 + b (0.0720 t^3 - 0.4376 t^2 + 0.9948 t)    b = 1 + c Y
//! others  delta0 + b f(t)                                    delta0 = 0, b = 1 by default
//! auto    delta + (1 - delta) [(1 - lambda) s(x) + lambda x s(Y) / Y]    s(x) = 1 - exp(-k x), delta = 0.075
//! ```
//!
//! clamped to [0, 1] for x from 0 on, and T(-x) = 2 T(0) - T(x) below 0, where t = x / p90, Y is the mean luminance,
//! and the black level delta0 = alpha (1 - p10 / p90)^beta is high if shadows are crushed. The statistics are those of
//! one photograph, or means over a scene ([`Statistics`]). In the automatic curve, Y is the pixel's luminance, and the
//! gain k follows from the luminance of all photographs ([`Exposure`]); the gain of every other curve can, too.
//! [`FAMILIES`] is the table of all curves; an [`Expression`] of one's own, a [`Table`] of values from a file and a
//! camera [`Profile`] are curves, too.

mod exposure;
mod expression;
mod file;
mod histogram;
mod inverse;
mod mapping;
mod metering;
mod profile;
mod settings;
mod statistics;
mod table;

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use nightsplat_core::curves::{CURVE_AUTO, CURVE_NONE, CURVE_PROFILE, CURVE_TABLE, name_of};
pub use nightsplat_core::curves::{
    Constant, Constants, Dual, FAMILIES, Family, Real, SceneLaw, ToneCurve, ToneParameters,
    bounded, clamped, curve_at, mirrored, shoulder, toe, tone_curve,
};
use nightsplat_core::{Error, Result};

pub use self::exposure::all_black;
pub use self::exposure::{Exposure, exposure_knots, is_black};
pub use self::expression::Expression;
pub use self::file::CurveChoice;
pub use self::histogram::EMPTY_CHANNEL;
pub use self::histogram::LuminanceHistogram;
pub use self::inverse::{InverseTone, scene_law};
pub use self::mapping::{ALPHA, BASE_GAIN, CurveNumbers, GAIN_C, MeasuredPhotograph, THETA};
pub use self::metering::{BLACK_SKY, CurveEnds, MAX_GAIN, NEAR_WHITE, soft};
pub use self::profile::{PROFILE_WIDTH, Profile, SEGMENTS, profiled};
pub use self::settings::{OF_CURVE, ToneSettings};
pub use self::statistics::{Statistics, percentiles};
pub use self::statistics::{luminance, measurable};
pub use self::table::Table;
pub use self::table::table_at;

/// What a tone curve is; its name is parsed: `"ase".parse()`.
#[derive(Clone, Debug, PartialEq)]
pub enum Tone {
    /// A formula with constants.
    Formula(ToneCurve),
    /// The curve whose gain follows from all photographs: (1 - lambda) soft(x) + lambda x soft(Y) / Y.
    Auto,
    /// A formula of one's own.
    Expression(Expression),
    /// Values from a file.
    Table(Table),
    /// The colours of a camera.
    Profile(Profile),
    /// None: the targets are pictures of another program in this folder, by the names of the photographs.
    External(PathBuf),
}

impl Tone {
    /// The names of curves that need a file.
    const OF_FILES: [&str; 3] = ["table", "profile", "targets"];

    /// The formula's row in the table.
    #[doc(hidden)]
    pub fn family(&self) -> Option<&'static Family> {
        match self {
            Self::Formula(curve) => Some(curve.family()),
            _ => None,
        }
    }

    /// The constants of its formula.
    #[doc(hidden)]
    pub fn constants(&self) -> &[Constant] {
        match self {
            Self::Formula(curve) => curve.family().constants,
            Self::Expression(expression) => expression.constants(),
            Self::Auto | Self::Table(_) | Self::Profile(_) | Self::External(_) => &[],
        }
    }

    /// The formula in terms of its constants; "none" without one.
    #[doc(hidden)]
    pub fn formula(&self) -> &str {
        match self {
            Self::Formula(curve) => curve.family().formula,
            Self::Expression(expression) => expression.formula(),
            Self::Auto | Self::Table(_) | Self::Profile(_) | Self::External(_) => "none",
        }
    }

    /// The name on the command line, or the formula of one's own.
    pub fn name(&self) -> &str {
        match self {
            Self::Expression(expression) => expression.formula(),
            Self::External(_) => "targets",
            _ => name_of(self.constant()),
        }
    }

    /// The number in `include/curves.glsl`: the specialization constant `TONE_CURVE`.
    #[doc(hidden)]
    pub fn constant(&self) -> u32 {
        match self {
            Self::Formula(curve) => curve.constant(),
            Self::Auto => CURVE_AUTO,
            Self::Expression(_) | Self::Table(_) => CURVE_TABLE,
            Self::Profile(_) => CURVE_PROFILE,
            Self::External(_) => CURVE_NONE,
        }
    }

    /// Whether it is a function of t = x / p90.
    #[doc(hidden)]
    pub fn is_of_t(&self) -> bool {
        match self {
            Self::Formula(curve) => curve.family().is_of_t,
            Self::Expression(expression) => !expression.is_of_stored(),
            Self::Table(table) => !table.is_of_stored,
            Self::Auto | Self::Profile(_) | Self::External(_) => false,
        }
    }

    /// The curve at the sRGB-encoded value `x`, in the arithmetic of the kernels.
    #[doc(hidden)]
    pub fn apply(&self, x: f32, parameters: &ToneParameters) -> f32 {
        tone_curve(self.constant(), x, parameters)
    }

    /// Whether the gain of the curve always follows from the photographs.
    #[doc(hidden)]
    pub fn is_exposed(&self) -> bool {
        matches!(self, Self::Auto | Self::Profile(_))
    }
}

impl From<ToneCurve> for Tone {
    fn from(curve: ToneCurve) -> Self {
        Self::Formula(curve)
    }
}

impl PartialEq<ToneCurve> for Tone {
    fn eq(&self, curve: &ToneCurve) -> bool {
        matches!(self, Self::Formula(formula) if formula == curve)
    }
}

impl fmt::Display for Tone {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Expression(expression) => expression.fmt(f),
            Self::External(folder) => {
                let name = folder.file_name().unwrap_or_default().to_string_lossy();
                f.pad(&format!("targets of another program, {name}"))
            }
            _ => f.pad(self.name()),
        }
    }
}

impl FromStr for Tone {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match name.to_ascii_lowercase().as_str() {
            "auto" => Ok(Self::Auto),
            "table" => Err(Error::Usage(
                "a table of values is named by its file: FILE.csv or FILE.cube".to_owned(),
            )),
            "profile" => Err(Error::Usage(
                "a camera profile is named by its file: --profile FILE".to_owned(),
            )),
            "targets" => Err(Error::Usage(
                "targets of another program are named by their folder: --targets DIR".to_owned(),
            )),
            _ => name.parse().map(Self::Formula).or_else(|unknown| {
                let expression = name.parse().map(Self::Expression);
                expression.map_err(|wrong| if is_word(name) { unknown } else { wrong })
            }),
        }
    }
}

/// Whether a text names a curve rather than being a formula.
fn is_word(text: &str) -> bool {
    text.chars().all(|c| c.is_alphanumeric() || matches!(c, '_' | '-' | '.'))
}
