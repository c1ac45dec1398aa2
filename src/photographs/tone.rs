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
//! [`FAMILIES`] is the table of all curves; a [`Table`] of values from a file and a camera [`Profile`] are curves, too.

#[cfg(feature = "io")]
mod curve;
#[cfg(feature = "io")]
mod exposure;
mod families;
#[cfg(feature = "io")]
mod file;
#[cfg(feature = "io")]
mod histogram;
#[cfg(feature = "io")]
mod inverse;
#[cfg(feature = "io")]
mod mapping;
#[cfg(feature = "io")]
mod metering;
#[cfg(feature = "io")]
mod profile;
mod real;
mod scene_law;
#[cfg(feature = "io")]
mod settings;
#[cfg(feature = "io")]
mod statistics;
#[cfg(feature = "io")]
mod table;

#[cfg(feature = "cli")]
pub(crate) use self::curve::{Curve, Variable};
#[cfg(feature = "io")]
pub(crate) use self::curve::{bounded, clamped, curve_at, mirrored, tone_curve};
#[cfg(feature = "io")]
pub(crate) use self::exposure::all_black;
#[cfg(feature = "io")]
pub use self::exposure::{Exposure, exposure_knots, is_black};
pub use self::families::{Constant, FAMILIES, Family, ToneCurve, White};
#[cfg(feature = "io")]
pub use self::file::CurveChoice;
#[cfg(feature = "io")]
pub(crate) use self::histogram::EMPTY_CHANNEL;
#[cfg(feature = "io")]
pub use self::histogram::LuminanceHistogram;
#[cfg(feature = "io")]
pub use self::inverse::{InverseTone, Inverted};
#[cfg(feature = "io")]
pub use self::mapping::{MeasuredPhotograph, ToneMapping};
#[cfg(feature = "io")]
pub(crate) use self::metering::MAX_GAIN;
#[cfg(feature = "io")]
pub use self::metering::{CurveEnds, NEAR_WHITE, soft};
#[cfg(feature = "check")]
pub(crate) use self::metering::{shoulder, toe};
#[cfg(feature = "io")]
pub use self::profile::Profile;
#[cfg(feature = "check")]
pub(crate) use self::profile::profiled;
#[cfg(feature = "cli")]
pub(crate) use self::real::Dual;
pub use self::real::Real;
pub use self::scene_law::SceneLaw;
#[cfg(feature = "io")]
pub(crate) use self::settings::OF_CURVE;
#[cfg(feature = "io")]
pub use self::settings::{GainChoice, ToneSettings};
#[cfg(feature = "io")]
pub use self::statistics::{Statistics, percentiles};
#[cfg(feature = "io")]
pub(crate) use self::statistics::{luminance, measurable};
#[cfg(feature = "io")]
pub use self::table::Table;
#[cfg(feature = "check")]
pub(crate) use self::table::table_at;
pub use crate::kernels::ToneParameters;
use crate::kernels::curves::{CURVE_AUTO, CURVE_PROFILE, CURVE_TABLE};
use crate::{Error, Result};
use std::fmt;
use std::str::FromStr;

/// The name of the curve of this number in `include/curves.glsl`.
fn name_of(number: u32) -> &'static str {
    match number {
        CURVE_TABLE => "table",
        CURVE_AUTO => "auto",
        CURVE_PROFILE => "profile",
        family => FAMILIES[family as usize].name,
    }
}

impl ToneCurve {
    /// The formula's row in the table.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn family(self) -> &'static Family {
        &FAMILIES[self as usize]
    }

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        self.family().name
    }

    /// The number in `include/curves.glsl`: the specialization constant `TONE_CURVE`.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn constant(self) -> u32 {
        self as u32
    }

    /// The curve at t = x / white, in [0, 1], in f64.
    ///
    /// `lum_preserve` and `per_channel` are straight lines here: they depend on more than one value.
    #[cfg(any(test, feature = "testing"))]
    pub fn value(self, t: f64, offset: f64, gain: f64, constants: &[f64]) -> f64 {
        let constants = families::padded(constants);
        clamped(curve_at(self.constant(), t, [offset, gain], &constants))
    }

    /// The curve at the sRGB-encoded value `x`, in the arithmetic of the kernels.
    #[cfg(any(test, feature = "testing"))]
    pub fn apply(self, x: f32, parameters: &ToneParameters) -> f32 {
        tone_curve(self.constant(), x, parameters)
    }

    /// All names, for help texts and errors.
    pub(crate) fn names() -> String {
        let families = Self::ALL.map(Self::name).join(", ");
        format!("{}, {families}", name_of(CURVE_AUTO))
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
        Family::find(name).map(|family| family.curve).ok_or_else(|| {
            Error::Usage(format!("unknown curve `{name}`; the curves are {}", Self::names()))
        })
    }
}

/// What a tone curve is.
///
/// ```
/// use nightsplat::{Tone, ToneSettings, TrainConfig};
///
/// let curve: Tone = "ase".parse()?;
/// let config = TrainConfig { tone: ToneSettings::new(curve), ..TrainConfig::default() };
/// config.check()?;
/// # Ok::<(), nightsplat::Error>(())
/// ```
#[cfg(feature = "io")]
#[derive(Clone, Debug, PartialEq)]
pub enum Tone {
    /// A formula with constants.
    Formula(ToneCurve),
    /// The curve whose gain follows from all photographs: (1 - lambda) soft(x) + lambda x soft(Y) / Y.
    Auto,
    /// Values from a file.
    Table(Table),
    /// The colours of a camera.
    Profile(Profile),
}

#[cfg(feature = "io")]
impl Tone {
    /// The names of curves that need a file.
    const OF_FILES: [&str; 2] = ["table", "profile"];

    /// The formula's row in the table.
    pub(crate) fn family(&self) -> Option<&'static Family> {
        match self {
            Self::Formula(curve) => Some(curve.family()),
            _ => None,
        }
    }

    /// The name on the command line.
    pub fn name(&self) -> &'static str {
        name_of(self.constant())
    }

    /// The number in `include/curves.glsl`: the specialization constant `TONE_CURVE`.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn constant(&self) -> u32 {
        match self {
            Self::Formula(curve) => curve.constant(),
            Self::Auto => CURVE_AUTO,
            Self::Table(_) => CURVE_TABLE,
            Self::Profile(_) => CURVE_PROFILE,
        }
    }

    /// The curve at the sRGB-encoded value `x`, in the arithmetic of the kernels.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn apply(&self, x: f32, parameters: &ToneParameters) -> f32 {
        tone_curve(self.constant(), x, parameters)
    }

    /// Whether the gain of the curve always follows from the photographs.
    pub(crate) fn is_exposed(&self) -> bool {
        matches!(self, Self::Auto | Self::Profile(_))
    }
}

#[cfg(feature = "io")]
impl From<ToneCurve> for Tone {
    fn from(curve: ToneCurve) -> Self {
        Self::Formula(curve)
    }
}

#[cfg(feature = "io")]
impl PartialEq<ToneCurve> for Tone {
    fn eq(&self, curve: &ToneCurve) -> bool {
        matches!(self, Self::Formula(formula) if formula == curve)
    }
}

#[cfg(feature = "io")]
impl fmt::Display for Tone {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

#[cfg(feature = "io")]
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
            _ => name.parse().map(Self::Formula),
        }
    }
}
