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
//! clamped to [0, 1], where t = x / p90, Y is the mean luminance, and the black level delta0 = alpha (1 - p10 /
//! p90)^beta is high if shadows are crushed. The statistics are those of one photograph, or means over a scene
//! ([`Statistics`]). In the automatic curve, Y is the pixel's luminance, and the gain k follows from the luminance of
//! all photographs ([`Exposure`]); the gain of every other curve can, too. [`FAMILIES`] is the table of all curves; a
//! [`Table`] of values from a file and a camera [`Profile`] are curves, too.

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
mod law;
#[cfg(feature = "io")]
mod mapping;
#[cfg(feature = "io")]
mod profile;
mod real;
#[cfg(feature = "io")]
mod recorded;
mod scene_law;
#[cfg(feature = "io")]
mod settings;
#[cfg(feature = "io")]
mod statistics;
#[cfg(feature = "io")]
mod table;

#[cfg(feature = "io")]
pub(crate) use self::exposure::all_black;
#[cfg(feature = "io")]
pub use self::exposure::{Exposure, exposed_anew, is_black, soft};
pub use self::families::{Constant, FAMILIES, Family, OffsetMode, ToneCurve, White};
#[cfg(feature = "io")]
pub use self::file::CurveChoice;
#[cfg(feature = "io")]
pub use self::histogram::LuminanceHistogram;
#[cfg(feature = "io")]
pub use self::inverse::{InverseTone, Inverted};
#[cfg(feature = "cli")]
pub(crate) use self::law::{CurveInputs, PhotographCurve, law};
#[cfg(feature = "io")]
pub(crate) use self::law::{clamped, curve_at, tone_curve};
#[cfg(feature = "io")]
pub use self::mapping::{MeasuredPhotograph, SceneTone};
#[cfg(feature = "io")]
pub use self::profile::Profile;
#[cfg(feature = "check")]
pub(crate) use self::profile::profiled;
#[cfg(feature = "cli")]
pub(crate) use self::real::Dual;
pub use self::real::Real;
#[cfg(feature = "io")]
pub(crate) use self::recorded::ToneLaw;
#[cfg(feature = "io")]
pub use self::recorded::ToneMapping;
pub use self::scene_law::SceneLaw;
#[cfg(feature = "io")]
pub(crate) use self::settings::OF_CURVE;
#[cfg(feature = "io")]
pub use self::settings::{GainChoice, ToneSettings};
#[cfg(feature = "io")]
pub use self::statistics::{Statistics, percentile};
#[cfg(feature = "io")]
pub(crate) use self::statistics::{luminance, measurable};
#[cfg(feature = "check")]
pub(crate) use self::table::interpolate;
#[cfg(feature = "io")]
pub use self::table::{Table, TableInput};
pub use crate::kernels::ToneParameters;
use crate::{Error, Result};
use std::fmt;
use std::str::FromStr;

/// The name of the curve given by a table of values.
const TABLE_NAME: &str = "table";

/// The name of the curve with automatic gain.
const AUTO_NAME: &str = "auto";

/// The name of the curve given by a camera profile.
const PROFILE_NAME: &str = "profile";

impl ToneCurve {
    /// The curve's row in the table. A [`Table`] or a [`Profile`] has no formula, and the row of `none`; the automatic
    /// curve has the row of `ase`, its formula for grey.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn family(self) -> &'static Family {
        &FAMILIES[match self {
            Self::Table | Self::Profile => Self::None,
            Self::Auto => Self::Ase,
            family => family,
        } as usize]
    }

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Table => TABLE_NAME,
            Self::Auto => AUTO_NAME,
            Self::Profile => PROFILE_NAME,
            family => family.family().name,
        }
    }

    /// The curve's number in `include/curves.glsl`: the specialization constant `TONE_CURVE`.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn constant(self) -> u32 {
        self as u32
    }

    /// The curve of that number.
    #[cfg(feature = "check")]
    pub(crate) fn of_constant(constant: u32) -> Option<Self> {
        let others = [Self::Table, Self::Auto, Self::Profile];
        Self::ALL.into_iter().chain(others).find(|curve| curve.constant() == constant)
    }

    /// The curve at t = x / white, in [0, 1], in f64.
    ///
    /// `lum_preserve` and `per_channel` are straight lines here: they depend on more than one value.
    #[cfg(feature = "io")]
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn value(self, t: f64, offset: f64, gain: f64, constants: &[f64]) -> f64 {
        let constants = families::padded(constants);
        clamped(curve_at(self.constant(), t, [offset, gain], &constants))
    }

    /// The curve at the sRGB-encoded value `x`, in the arithmetic of the kernels.
    #[cfg(feature = "io")]
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn apply(self, x: f32, parameters: &ToneParameters) -> f32 {
        tone_curve(self.constant(), x, parameters)
    }

    /// Whether each value of the target is a formula of one value of the photograph.
    pub(crate) fn is_formula(self) -> bool {
        !matches!(
            self,
            Self::Table | Self::LumPreserve | Self::PerChannel | Self::Auto | Self::Profile
        )
    }

    /// All names, for help texts and errors.
    pub(crate) fn names() -> String {
        let families = Self::ALL.map(Self::name).join(", ");
        format!("{AUTO_NAME}, {families}")
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
        // Names are in lower case; papers write AP3.
        let small = name.to_ascii_lowercase();
        match small.as_str() {
            TABLE_NAME => return Ok(Self::Table),
            AUTO_NAME => return Ok(Self::Auto),
            PROFILE_NAME => return Ok(Self::Profile),
            _ => {}
        }
        Family::find(&small).map(|family| family.curve).ok_or_else(|| {
            Error::Usage(format!("unknown curve `{name}`; the curves are {}", Self::names()))
        })
    }
}

impl TryFrom<String> for ToneCurve {
    type Error = Error;

    fn try_from(name: String) -> Result<Self> {
        name.parse()
    }
}

impl From<ToneCurve> for String {
    fn from(curve: ToneCurve) -> Self {
        curve.name().to_owned()
    }
}
