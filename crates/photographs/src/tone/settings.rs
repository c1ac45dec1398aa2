//! A curve with all its constants, as on the command line, in TOML files and in run directories.

use std::any::Any;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nightsplat_core::settings::{self, Rule, Setting};
use nightsplat_core::{Error, Result};
use serde::{Deserialize, Serialize};

use super::metering::BLACK_LEVEL;
use super::{Constant, Profile, Table, Tone, ToneCurve};

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
    /// The curve.
    pub curve: Tone,
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
    /// The formula's constants in the order of its formula.
    pub constants: Vec<f64>,
    /// The file with the tone mapping of every photograph, in place of measuring them.
    pub law: Option<PathBuf>,
}

/// Largest value for the kernels, which compute in 32 bits.
const MOST: f64 = 1e30;

/// Whether a curve has this name.
fn is_name(name: &str) -> bool {
    Tone::OF_FILES.contains(&name) || name.parse::<Tone>().is_ok()
}

/// Settings that belong to a curve: choosing another curve resets them.
pub const OF_CURVE: [&str; 11] = [
    "gain_c",
    "alpha",
    "auto_gain",
    "colour",
    "full_resolution",
    "constants",
    "bounds",
    "targets",
    "table",
    "profile",
    "law",
];

impl ToneSettings {
    /// A row for each setting.
    #[doc(hidden)]
    pub const SETTINGS: &'static [Setting] = nightsplat_core::settings! { rows "tone."
        /// The tone curve: a name that `nightsplat tone list` lists, or a formula of t = x / p90 or of x.
        curve => Rule::Text("a curve that `nightsplat tone list` lists, or a formula", is_name),
           "--curve NAME|FORMULA|FILE";
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
        brightness, "chosen between 0.42 and 0.54" => Rule::from_to(0.1, 0.9), "--brightness T";
        /// Share of the curve auto that keeps the ratios of the channels.
        colour => Rule::SHARE, "--colour L";
        /// Tone-map photographs before they are resized.
        full_resolution, "as auto_gain" => Rule::Flag;
        /// The constants of the curve's formula, by name.
        constants, "the curve's" => Rule::Table("a table with every constant of the curve");
        /// The bounds of the constants of a formula of one's own in a fit, [low, high] by name.
        bounds, "a tenth to ten times the constant" => Rule::Table("a table of [low, high]");
        /// The values of the curve `table`, read by --curve from a .csv or .cube file.
        table, "none" => Rule::Table("a table of values");
        /// The camera profile of the curve `profile`, read by --profile.
        profile, "none" => Rule::Table("a camera profile");
        /// Folder of targets that another program made, by the names of the photographs, of the curve `targets`.
        targets, "none" => Rule::PATH;
        /// File with the curve of every photograph, as `nightsplat blocks plan` writes it, instead of measuring them.
        law, "the photographs are measured" => Rule::PATH, "--law FILE";
    };

    /// A curve with its default constants, those of the paper for LOM; c is 3 for ASE and 1 for AP3. The automatic
    /// curve is applied before photographs are resized, the others after.
    pub fn new(curve: impl Into<Tone>) -> Self {
        let curve = curve.into();
        let (family, is_exposed) = (curve.family(), curve.is_exposed());
        let alpha = if curve == Tone::Auto { BLACK_LEVEL } else { 0.0 };
        let constants = curve.constants().iter().map(|constant| constant.default).collect();
        Self {
            curve,
            gain_c: family.map_or(0.0, |family| family.gain_c),
            theta: 0.49,
            alpha: family.map_or(alpha, |family| family.alpha),
            beta: 2.5,
            base_gain: 1.0,
            scene_statistics: false,
            auto_gain: is_exposed,
            brightness: None,
            colour: COLOUR,
            full_resolution: is_exposed,
            constants,
            law: None,
        }
    }

    /// Another curve with its own constants, c and alpha; theta, beta, g0, brightness and the kind of statistics are
    /// kept. The same curve keeps everything.
    #[must_use]
    #[doc(hidden)]
    pub fn with_curve(&self, curve: impl Into<Tone>) -> Self {
        let curve = curve.into();
        if curve == self.curve {
            return self.clone();
        }
        let Self { theta, beta, base_gain, scene_statistics, brightness, .. } = *self;
        Self { theta, beta, base_gain, scene_statistics, brightness, ..Self::new(curve) }
    }

    /// The same curve with another c; `None`: with an automatic gain, which implies full resolution.
    #[must_use]
    #[doc(hidden)]
    pub fn with_gain(self, gain_c: Option<f64>) -> Self {
        match gain_c {
            None => Self { auto_gain: true, full_resolution: true, ..self },
            Some(gain_c) if self.auto_gain => {
                Self { gain_c, auto_gain: false, full_resolution: false, ..self }
            }
            Some(gain_c) => Self { gain_c, ..self },
        }
    }

    /// The settings with every number as the shortest decimal that has the same f32, the precision of the kernels.
    #[must_use]
    #[doc(hidden)]
    pub fn rounded(self) -> Self {
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
        let constants: Vec<f64> = self.constants.iter().copied().map(round).collect();
        Self { gain_c, theta, alpha, beta, base_gain, colour, brightness, constants, ..self }
    }

    /// The values that kernels interpolate, of a table or of a formula of one's own.
    #[doc(hidden)]
    pub fn table(&self) -> Option<Cow<'_, Table>> {
        match &self.curve {
            Tone::Table(table) => Some(Cow::Borrowed(table)),
            Tone::Expression(expression) => Some(Cow::Owned(expression.table(&self.constants))),
            Tone::Formula(_) | Tone::Auto | Tone::Profile(_) | Tone::External(_) => None,
        }
    }

    /// The folder of targets that another program made.
    #[doc(hidden)]
    pub fn targets(&self) -> Option<&Path> {
        match &self.curve {
            Tone::External(folder) => Some(folder),
            _ => None,
        }
    }

    /// Whether the curve raises black by delta0.
    #[doc(hidden)]
    pub fn has_black_level(&self) -> bool {
        let is_of_t = self.curve.family().is_some_and(|family| family.is_of_t);
        self.alpha > 0.0 && (is_of_t || self.curve == Tone::Auto)
    }

    /// Whether the gain follows from the photographs' [`super::Exposure`].
    #[doc(hidden)]
    pub fn takes_exposure(&self) -> bool {
        self.auto_gain || self.curve == Tone::Auto
    }

    /// What the targets take from reference images, if anything; results are labelled with it.
    #[doc(hidden)]
    pub fn knows_references(&self) -> Option<String> {
        match &self.curve {
            Tone::Profile(profile) => Some(profile.label()),
            _ => None,
        }
    }

    /// Checks the constants: the curve must be defined, and its black level within [0, 1].
    #[doc(hidden)]
    pub fn check(&self) -> Result<()> {
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
        if self.curve == Tone::Auto && self.gain_c != 0.0 {
            return Err(format!(
                "the curve `{name}` takes no gain (tone.gain_c); tone.brightness sets its mean luminance"
            ));
        }
        if matches!(self.curve, Tone::Profile(_))
            && (self.gain_c != 0.0 || !self.auto_gain || self.brightness.is_some())
        {
            return Err(
                "a camera profile is as bright as its references: it takes no gain (tone.gain_c) \
                        and no tone.brightness"
                    .to_owned(),
            );
        }
        // The others scale no value by itself.
        let has_gain = match &self.curve {
            Tone::Formula(curve) => {
                !matches!(curve, ToneCurve::None | ToneCurve::LumPreserve | ToneCurve::PerChannel)
            }
            other => other.is_exposed(),
        };
        if self.auto_gain && !has_gain {
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
        match &self.curve {
            Tone::Expression(expression) => expression.check(&self.constants)?,
            Tone::Table(table) => table.check()?,
            Tone::Profile(profile) => profile.check()?,
            Tone::Formula(_) | Tone::Auto | Tone::External(_) => {}
        }
        let (given, needed) = (self.constants.len(), self.curve.constants().len());
        if given != needed {
            return Err(format!("the curve `{name}` has {needed} constants, not {given}"));
        }
        let Some(family) = family else { return Ok(()) };
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
}

impl Default for ToneSettings {
    fn default() -> Self {
        Self::new(Tone::Auto)
    }
}

/// The settings in TOML.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SerializedToneSettings {
    curve: Option<String>,
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
    bounds: Option<BTreeMap<String, [f64; 2]>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    table: Option<Table>,
    #[serde(skip_serializing_if = "Option::is_none")]
    profile: Option<Profile>,
    #[serde(skip_serializing_if = "Option::is_none")]
    targets: Option<PathBuf>,
    #[serde(skip_serializing_if = "Option::is_none")]
    law: Option<PathBuf>,
}

/// The curve of a name and of the contents of its file.
fn written_curve(
    name: Option<String>,
    table: Option<Table>,
    profile: Option<Profile>,
) -> Result<Tone, String> {
    let problem = match (name.as_deref(), table, profile) {
        (None, None, None) => return Ok(Tone::Auto),
        (None | Some("table"), Some(table), None) => return Ok(Tone::Table(table)),
        (None | Some("profile"), None, Some(profile)) => return Ok(Tone::Profile(profile)),
        (Some("table"), None, _) => "needs a file of values; name a .csv or .cube file",
        (Some("profile"), _, None) => "needs a camera profile; name a file with --profile",
        (Some(name), None, None) => return name.parse().map_err(|error: Error| error.to_string()),
        (Some("table") | None, _, Some(_)) => "takes no camera profile",
        (Some(_), Some(_), _) => "takes no table of values",
        (Some(_), None, Some(_)) => "takes no camera profile",
    };
    Err(format!("the curve `{}` {problem}", name.unwrap_or_default()))
}

/// The constants of a curve in the order of its formula. Those of a formula of one's own may state values already.
fn constants_of(curve: &Tone, mut values: BTreeMap<String, f64>) -> Result<Vec<f64>, String> {
    let (name, formula) = (curve.name(), curve.formula());
    let is_own = matches!(curve, Tone::Expression(_));
    let value = |constant: &Constant| {
        let value = values.remove(constant.name.as_ref());
        value.or(is_own.then_some(constant.default)).ok_or_else(|| {
            let missing = &constant.name;
            format!("the curve `{name}` needs the constant `{missing}`; its formula is {formula}")
        })
    };
    let constants = curve.constants().iter().map(value).collect::<Result<_, _>>()?;
    match values.keys().next() {
        Some(other) => {
            Err(format!("the curve `{name}` has no constant `{other}`; its formula is {formula}"))
        }
        None => Ok(constants),
    }
}

impl TryFrom<SerializedToneSettings> for ToneSettings {
    type Error = String;

    fn try_from(written: SerializedToneSettings) -> Result<Self, String> {
        let mut curve = match (written.curve.as_deref(), written.targets) {
            (None | Some("targets"), Some(folder)) => Tone::External(folder),
            (Some(name), Some(_)) => return Err(format!("the curve `{name}` takes no targets")),
            (_, None) => written_curve(written.curve, written.table, written.profile)?,
        };
        let constants = match written.constants {
            Some(values) => constants_of(&curve, values)?,
            None => curve.constants().iter().map(|constant| constant.default).collect(),
        };
        match &mut curve {
            Tone::Expression(expression) => {
                *expression = expression.with(&constants, &written.bounds.unwrap_or_default())?;
            }
            _ if written.bounds.is_some() => {
                return Err(format!("the curve `{curve}` takes no bounds; its row has them"));
            }
            _ => {}
        }
        let defaults = Self::new(curve);
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
            law: written.law,
        };
        settings.check_constants()?;
        Ok(settings)
    }
}

impl From<ToneSettings> for SerializedToneSettings {
    fn from(settings: ToneSettings) -> Self {
        let names = settings.curve.constants().iter().map(|constant| constant.name.to_string());
        let constants: BTreeMap<String, f64> = names.zip(settings.constants).collect();
        let name = settings.curve.name().to_owned();
        let (mut bounds, mut table, mut profile, mut targets) = (None, None, None, None);
        match settings.curve {
            Tone::Expression(expression) => {
                let constants = expression.constants().iter();
                bounds = Some(constants.map(|one| (one.name.to_string(), one.bounds)).collect());
            }
            Tone::Table(of_file) => table = Some(of_file),
            Tone::Profile(of_file) => profile = Some(of_file),
            Tone::External(folder) => targets = Some(folder),
            Tone::Formula(_) | Tone::Auto => {}
        }
        Self {
            curve: Some(name),
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
            bounds: bounds.filter(|bounds: &BTreeMap<_, _>| !bounds.is_empty()),
            table,
            profile,
            targets,
            law: settings.law,
        }
    }
}
