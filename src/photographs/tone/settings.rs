//! A curve with all its constants, as on the command line, in TOML files and in run directories.

use std::any::Any;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::exposure::BLACK_LEVEL;
use super::families::{White, padded};
use super::law::{CurveInputs, black_level, law};
use super::real::Real;
use super::{Profile, Statistics, Table, ToneCurve, ToneParameters};
use crate::base::settings::{self, Rule, Setting};
use crate::{Error, Result};

/// lambda by default: the reference images keep more of the colours than single curves do.
const COLOUR: f64 = 1.0 / 3.0;

/// A larger value of a shape indicates a pole near p90.
const LARGEST_SHAPE: f64 = 1e8;

/// A curve and its constants; percentiles and means are added per photograph.
///
/// In TOML, everything except `curve` is optional; `[constants]`, if present, must have all of the family's.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "SerializedToneSettings", into = "SerializedToneSettings")]
pub struct ToneSettings {
    /// The family.
    pub curve: ToneCurve,
    /// c: the gain per mean luminance of the photograph.
    pub gain_c: f64,
    /// theta: the target mean of the linear curve over all channels, before clipping.
    pub theta: f64,
    /// alpha: the highest black level.
    pub alpha: f64,
    /// beta: how fast the black level falls as p10 approaches p90; 0: alpha for every photograph.
    pub beta: f64,
    /// g0: the gain of ASE for a black photograph.
    pub base_gain: f64,
    /// Whether one curve is used for a scene: its statistics are the means over the training views, its gain that of
    /// all of them together.
    pub scene_statistics: bool,
    /// Whether the gain is solved for a brightness chosen from the photographs: then t is k x instead of x / white, and
    /// c and g0 are not used. Always set for the automatic curve.
    pub auto_gain: bool,
    /// The mean luminance of the targets; by default chosen from the photographs.
    pub brightness: Option<f64>,
    /// lambda: the share of the automatic curve that keeps the ratios of the channels.
    pub colour: f64,
    /// Whether a photograph is tone-mapped before it is resized. Reference images were resized after their own tone
    /// curve, and the mean of a curve is not the curve of a mean.
    pub full_resolution: bool,
    /// The family's constants in the order of its formula.
    pub constants: Vec<f64>,
    /// The values of [`ToneCurve::Table`].
    pub table: Option<Table>,
    /// The profile of [`ToneCurve::Profile`].
    pub profile: Option<Profile>,
    /// The file with the tone mapping of every photograph, in place of measuring them.
    pub law: Option<PathBuf>,
}

/// Largest value for the kernels, which compute in 32 bits.
const MOST: f64 = 1e30;

/// Settings that belong to a curve: choosing another curve resets them.
pub(crate) const OF_CURVE: [&str; 9] = [
    "gain_c",
    "alpha",
    "auto_gain",
    "colour",
    "full_resolution",
    "constants",
    "table",
    "profile",
    "law",
];

impl<T: Real> From<&ToneSettings> for CurveInputs<T> {
    fn from(settings: &ToneSettings) -> Self {
        Self {
            theta: T::of(settings.theta),
            alpha: T::of(settings.alpha),
            beta: settings.beta,
            gain_c: T::of(settings.gain_c),
            base_gain: T::of(settings.base_gain),
            constants: padded(&settings.constants).map(T::of),
        }
    }
}

impl ToneSettings {
    /// A row for each setting.
    pub(crate) const SETTINGS: &'static [Setting] = settings::settings! { rows "tone."
        /// The tone curve: a name that `nightsplat tone list` lists.
        curve => Rule::Text("a curve that `nightsplat tone list` lists", |name| name.parse::<ToneCurve>().is_ok()),
           "--curve NAME|FILE";
        /// c: the gain per mean luminance of the photograph.
        gain_c, "the curve's" => Rule::from_to(0.0, MOST), "--gain C|auto";
        /// Target mean of the curve linear over all channels, before clipping.
        theta => Rule::above(0.0, MOST), "--theta T";
        /// alpha: the highest black level.
        alpha, "the curve's" => Rule::SHARE;
        /// beta: how fast the black level falls as p10 approaches p90; 0: alpha for every photograph.
        beta => Rule::from_to(0.0, MOST);
        /// g0: the gain of ASE for a black photograph.
        base_gain => Rule::above(0.0, MOST);
        /// Use one curve for a scene: its statistics are the means over the training views, its gain that of all of
        /// them together.
        scene_statistics => Rule::Flag, "--scene-statistics";
        /// Choose the gain from the photographs; c and g0 are then not used. Always on for the curve auto.
        auto_gain, "the curve's" => Rule::Flag;
        /// Mean luminance of the targets, with an automatic gain.
        brightness, "chosen between 0.44 and 0.54" => Rule::from_to(0.1, 0.9), "--brightness T";
        /// Share of the curve auto that keeps the ratios of the channels.
        colour => Rule::SHARE, "--colour L";
        /// Tone-map photographs before they are resized.
        full_resolution, "as auto_gain" => Rule::Flag;
        /// The constants of the curve's formula, by name.
        constants, "the curve's" => Rule::Table("a table with every constant of the curve");
        /// The values of the curve `table`, read by --curve from a .csv or .cube file.
        table, "none" => Rule::Table("a table of values");
        /// The camera profile of the curve `profile`, read by --profile.
        profile, "none" => Rule::Table("a camera profile");
        /// File with the curve of every photograph, as `nightsplat blocks plan` writes it, instead of measuring them.
        law, "the photographs are measured" => Rule::PATH, "--law FILE";
    };

    /// A curve with its default constants, those of the paper for LOM; c is 3 for ASE and 1 for AP3. The automatic
    /// curve is applied before photographs are resized, the others after.
    pub fn new(curve: ToneCurve) -> Self {
        let family = curve.family();
        let is_auto = curve == ToneCurve::Auto;
        let is_exposed = is_auto || curve == ToneCurve::Profile;
        Self {
            curve,
            gain_c: if is_auto { 0.0 } else { family.gain_c },
            theta: 0.49,
            alpha: if is_auto { BLACK_LEVEL } else { family.alpha },
            beta: 2.5,
            base_gain: 1.0,
            scene_statistics: false,
            auto_gain: is_exposed,
            brightness: None,
            colour: COLOUR,
            full_resolution: is_exposed,
            constants: family.defaults(),
            table: None,
            profile: None,
            law: None,
        }
    }

    /// Another curve with its own constants, c and alpha; theta, beta, g0, brightness and the kind of statistics are
    /// kept. The same curve keeps everything.
    #[must_use]
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn with_curve(&self, curve: ToneCurve) -> Self {
        if curve == self.curve {
            return self.clone();
        }
        let Self { theta, beta, base_gain, scene_statistics, brightness, .. } = *self;
        Self { theta, beta, base_gain, scene_statistics, brightness, ..Self::new(curve) }
    }

    /// The same curve with another gain. An automatic gain implies full resolution.
    #[must_use]
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn with_gain(self, gain: GainChoice) -> Self {
        match gain {
            GainChoice::Auto => Self { auto_gain: true, full_resolution: true, ..self },
            GainChoice::C(gain_c) if self.auto_gain => {
                Self { gain_c, auto_gain: false, full_resolution: false, ..self }
            }
            GainChoice::C(gain_c) => Self { gain_c, ..self },
        }
    }

    /// The settings with every number as the shortest decimal that has the same f32, the precision of the kernels.
    #[must_use]
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn rounded(self) -> Self {
        let round = |value: f64| {
            let single = value as f32;
            // Without effect in a kernel, and hundreds of digits long.
            let single = if single.is_subnormal() { 0.0 } else { single };
            single.to_string().parse().unwrap_or(value)
        };
        let Self { gain_c, theta, alpha, beta, base_gain, colour, .. } = self;
        let [gain_c, theta, alpha, beta, base_gain, colour] =
            [gain_c, theta, alpha, beta, base_gain, colour].map(round);
        let brightness = self.brightness.map(round);
        let constants = self.constants.iter().copied().map(round).collect();
        Self { gain_c, theta, alpha, beta, base_gain, colour, brightness, constants, ..self }
    }

    /// Whether the gain follows from the photographs' [`super::Exposure`].
    pub(crate) fn takes_exposure(&self) -> bool {
        self.auto_gain || self.curve == ToneCurve::Auto
    }

    /// The curve of a table of values.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn of_table(table: Table) -> Self {
        Self { table: Some(table), ..Self::new(ToneCurve::Table) }
    }

    /// The curve of a camera profile, which follows the exposure of the photographs like the automatic curve.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn of_profile(profile: Profile) -> Self {
        Self { profile: Some(profile), ..Self::new(ToneCurve::Profile) }
    }

    /// What the targets take from reference images, if anything; results are labelled with it.
    pub(crate) fn knows_references(&self) -> Option<String> {
        self.profile.as_ref().map(Profile::label)
    }

    /// Checks the constants: the curve must be defined, and its black level within [0, 1].
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn check(&self) -> Result<()> {
        let values: [(&str, &dyn Any); 7] = [
            ("tone.gain_c", &self.gain_c),
            ("tone.theta", &self.theta),
            ("tone.alpha", &self.alpha),
            ("tone.beta", &self.beta),
            ("tone.base_gain", &self.base_gain),
            ("tone.brightness", &self.brightness),
            ("tone.colour", &self.colour),
        ];
        for (key, value) in values {
            settings::row(Self::SETTINGS, key).map_or(Ok(()), |row| row.check(value))?;
        }
        self.check_gain().and_then(|()| self.check_constants()).map_err(Error::Usage)
    }

    /// Checks the settings of brightness against each other.
    fn check_gain(&self) -> Result<(), String> {
        let name = self.curve.name();
        let has_gain = self.curve.is_formula() && self.curve != ToneCurve::None;
        if self.curve == ToneCurve::Auto && self.gain_c != 0.0 {
            return Err(format!(
                "the curve `{name}` takes no gain (tone.gain_c); tone.brightness sets its mean luminance"
            ));
        }
        if self.curve == ToneCurve::Profile
            && (self.gain_c != 0.0 || !self.auto_gain || self.brightness.is_some())
        {
            return Err(
                "a camera profile is as bright as its references: it takes no gain (tone.gain_c) \
                        and no tone.brightness"
                    .to_owned(),
            );
        }
        let is_exposed = matches!(self.curve, ToneCurve::Auto | ToneCurve::Profile);
        if self.auto_gain && !is_exposed && !has_gain {
            return Err(format!(
                "the curve `{name}` has no automatic gain; use `auto`, `ase` or `ap3`"
            ));
        }
        if self.brightness.is_some() && !self.takes_exposure() {
            return Err(format!(
                "the brightness of the curve `{name}` follows from its gain; tone.brightness requires an \
                 automatic gain"
            ));
        }
        Ok(())
    }

    fn check_constants(&self) -> Result<(), String> {
        let (name, family) = (self.curve.name(), self.curve.family());
        match (&self.table, self.curve) {
            (Some(table), ToneCurve::Table) => table.check()?,
            (None, ToneCurve::Table) => {
                return Err("the curve `table` needs a file of values; name a .csv or .cube file"
                    .to_owned());
            }
            (Some(_), _) => return Err(format!("the curve `{name}` takes no table of values")),
            (None, _) => {}
        }
        match (&self.profile, self.curve) {
            (Some(profile), ToneCurve::Profile) => profile.check()?,
            (None, ToneCurve::Profile) => {
                return Err(
                    "the curve `profile` needs a camera profile; name a file with --profile"
                        .to_owned(),
                );
            }
            (Some(_), _) => return Err(format!("the curve `{name}` takes no camera profile")),
            (None, _) => {}
        }
        if self.constants.len() != family.constants.len() {
            let (given, needed) = (self.constants.len(), family.constants.len());
            return Err(format!("the curve `{name}` has {needed} constants, not {given}"));
        }
        for (constant, value) in family.constants.iter().zip(&self.constants) {
            if !(*value as f32).is_finite() {
                return Err(format!(
                    "the constant {} of `{name}` is {value}; it must be finite",
                    constant.name
                ));
            }
        }
        // Written so that a NaN fails.
        let is_defined = |t: f64| family.shape(t, &self.constants).abs() <= LARGEST_SHAPE;
        let undefined = (0..=1000).map(|i| f64::from(i) * 0.01).find(|&t| !is_defined(t));
        match undefined {
            Some(t) => Err(format!(
                "`{name}` is undefined at t = {t} with these constants; its formula is {}",
                family.formula
            )),
            None => Ok(()),
        }
    }

    /// delta0 = alpha (1 - r)^beta: the black level of a photograph with r = p10 / p90. For the automatic curve it is
    /// alpha.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn offset(&self, ratio: f64) -> f64 {
        if self.curve == ToneCurve::Auto {
            self.alpha
        } else {
            black_level(self.alpha, self.beta, ratio)
        }
    }

    /// The curve of a photograph with these statistics; with an automatic gain, use [`Self::tone_mapping`].
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn parameters(&self, statistics: &Statistics) -> ToneParameters {
        if self.curve == ToneCurve::Profile {
            return ToneParameters {
                white: 1.0,
                gain: 1.0,
                weight: 1.0,
                ..ToneParameters::default()
            };
        }
        if self.curve == ToneCurve::Auto {
            let mut constants = [0.0; _];
            constants[0] = self.colour as f32;
            let offset = self.alpha as f32;
            return ToneParameters { white: 1.0, offset, gain: 1.0, weight: 1.0, constants };
        }
        let numbers = CurveInputs::<f64>::from(self);
        let curve = law(self.curve.family(), self.white(), &numbers, statistics);
        ToneParameters {
            white: curve.white as f32,
            offset: curve.offset as f32,
            gain: curve.gain as f32,
            weight: 1.0,
            constants: curve.constants.map(|constant| constant as f32),
        }
    }

    /// The value that t = 1 corresponds to.
    pub(crate) fn white(&self) -> White {
        match &self.table {
            Some(table) => table.input.white(),
            None if matches!(self.curve, ToneCurve::Auto | ToneCurve::Profile) => White::One,
            None => self.curve.family().white,
        }
    }

    /// The curve at t = x / p90, in [0, 1], for a photograph with these statistics. A table of three channels, or a
    /// profile, is evaluated for green, `lum_preserve` and `per_channel` for grey.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn value(&self, t: f64, statistics: &Statistics) -> f64 {
        let grey = Statistics { channel_means: [statistics.mean; 3], ..*statistics };
        let ToneParameters { mut white, offset, gain, constants, .. } = self.parameters(&grey);
        if self.white() == White::ChannelMeans {
            white = constants[0];
        }
        let t = match self.curve {
            // Without a scene that determines k: a function of k x.
            ToneCurve::Auto | ToneCurve::Profile => t,
            _ => t * f64::from(statistics.p90) / f64::from(white),
        };
        match (&self.table, &self.profile) {
            (Some(table), _) => table.value(t, 1),
            (None, Some(profile)) => profile.value([t; 3])[1],
            (None, None) => self.curve.value(t, offset.into(), gain.into(), &self.constants),
        }
    }

    /// Statistics for the plain formula of a curve: no black level, gain 1, and t = 1 at its white.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn plain_statistics(&self) -> Statistics {
        let theta = self.theta as f32;
        let means = Statistics { mean: theta, channel_means: [theta; 3], ..Statistics::default() };
        Statistics { p10: 1.0, p80: theta, p90: 1.0, ..means }
    }
}

/// The value of `--gain`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GainChoice {
    /// A gain chosen from the photographs.
    Auto,
    /// c: the gain per mean luminance of the photograph.
    C(f64),
}

impl FromStr for GainChoice {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        if text == "auto" {
            return Ok(Self::Auto);
        }
        let number = text.parse();
        number
            .map(Self::C)
            .map_err(|_| Error::Usage(format!("`{text}` is not a gain; use a number, or auto")))
    }
}

impl Default for ToneSettings {
    fn default() -> Self {
        Self::new(ToneCurve::Auto)
    }
}

/// The settings in TOML.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SerializedToneSettings {
    curve: Option<ToneCurve>,
    gain_c: Option<f64>,
    theta: Option<f64>,
    alpha: Option<f64>,
    beta: Option<f64>,
    base_gain: Option<f64>,
    scene_statistics: Option<bool>,
    auto_gain: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    brightness: Option<f64>,
    colour: Option<f64>,
    full_resolution: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    constants: Option<BTreeMap<String, f64>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    table: Option<Table>,
    #[serde(skip_serializing_if = "Option::is_none")]
    profile: Option<Profile>,
    #[serde(skip_serializing_if = "Option::is_none")]
    law: Option<PathBuf>,
}

impl TryFrom<SerializedToneSettings> for ToneSettings {
    type Error = String;

    fn try_from(written: SerializedToneSettings) -> Result<Self, String> {
        let given = match (&written.table, &written.profile) {
            (Some(_), _) => ToneCurve::Table,
            (None, Some(_)) => ToneCurve::Profile,
            (None, None) => ToneCurve::Auto,
        };
        let defaults = Self::new(written.curve.unwrap_or(given));
        let family = defaults.curve.family();
        let constants = match written.constants {
            None => defaults.constants,
            Some(mut values) => {
                let value = |constant: &super::Constant| {
                    values.remove(constant.name).ok_or_else(|| {
                        format!(
                            "the curve `{}` needs the constant `{}`; its formula is {}",
                            family.name, constant.name, family.formula
                        )
                    })
                };
                let constants = family.constants.iter().map(value).collect::<Result<_, _>>()?;
                if let Some(name) = values.keys().next() {
                    return Err(format!(
                        "the curve `{}` has no constant `{name}`; its formula is {}",
                        family.name, family.formula
                    ));
                }
                constants
            }
        };
        let auto_gain = written.auto_gain.unwrap_or(defaults.auto_gain);
        let settings = Self {
            curve: defaults.curve,
            gain_c: written.gain_c.unwrap_or(defaults.gain_c),
            theta: written.theta.unwrap_or(defaults.theta),
            alpha: written.alpha.unwrap_or(defaults.alpha),
            beta: written.beta.unwrap_or(defaults.beta),
            base_gain: written.base_gain.unwrap_or(defaults.base_gain),
            scene_statistics: written.scene_statistics.unwrap_or(defaults.scene_statistics),
            auto_gain,
            brightness: written.brightness,
            colour: written.colour.unwrap_or(defaults.colour),
            full_resolution: written.full_resolution.unwrap_or(auto_gain),
            constants,
            table: written.table,
            profile: written.profile,
            law: written.law,
        };
        settings.check_constants()?;
        Ok(settings)
    }
}

impl From<ToneSettings> for SerializedToneSettings {
    fn from(settings: ToneSettings) -> Self {
        let names = settings.curve.family().constants.iter();
        let constants: BTreeMap<String, f64> =
            names.map(|constant| constant.name.to_owned()).zip(settings.constants).collect();
        Self {
            curve: Some(settings.curve),
            gain_c: Some(settings.gain_c),
            theta: Some(settings.theta),
            alpha: Some(settings.alpha),
            beta: Some(settings.beta),
            base_gain: Some(settings.base_gain),
            scene_statistics: Some(settings.scene_statistics),
            auto_gain: Some(settings.auto_gain),
            brightness: settings.brightness,
            colour: Some(settings.colour),
            full_resolution: Some(settings.full_resolution),
            constants: Some(constants).filter(|constants| !constants.is_empty()),
            table: settings.table,
            profile: settings.profile,
            law: settings.law,
        }
    }
}
