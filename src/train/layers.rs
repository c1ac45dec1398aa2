//! The settings of a run, merged from defaults, preset, plan, file, options and `--set`; later ones win.
//!
//! Each is a [`SettingsLayer`]: keys of config.toml with values. [`Settings`] merges them and keeps the origin of every
//! value.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use nightsplat_core::input;
use nightsplat_core::settings::{Rule, Setting};
use nightsplat_photographs::tone::{OF_CURVE, Tone, ToneCurve};
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

use super::config::TrainConfig;
use super::settings::{SETTINGS, flat, number, setting, takes, unknown, value};
use crate::{Error, Result};

/// The origin of a value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origin {
    /// The default.
    Default,
    /// This preset.
    Preset(&'static str),
    /// The plan.
    Plan,
    /// A lamp at the camera, which needs one gain for all photographs.
    Lamp,
    /// This configuration file.
    File(PathBuf),
    /// This option of the command.
    Option(&'static str),
    /// `--set`.
    Set,
    /// The resumed run.
    Run,
}

impl fmt::Display for Origin {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Default => out.write_str("default"),
            Self::Preset(name) => write!(out, "preset {name}"),
            Self::Plan => out.write_str("plan"),
            Self::Lamp => out.write_str("the part lamp"),
            Self::File(path) => write!(out, "{}", path.display()),
            Self::Option(name) => out.write_str(name),
            Self::Set => out.write_str("--set"),
            Self::Run => out.write_str("the resumed run"),
        }
    }
}

/// Settings with their values; a later value of a key wins.
#[derive(Clone, Debug, Default)]
pub struct SettingsLayer(pub(super) Vec<(String, Value, Origin)>);

impl SettingsLayer {
    /// Every setting of a TOML text.
    pub fn of_toml(text: &str, origin: &Origin) -> Result<Self> {
        let table: Table = text.parse().map_err(|error: toml::de::Error| {
            let at = error.span().map(|span| line_at(text, span.start));
            let (problem, at) = (error.message(), at.unwrap_or_default());
            Error::Usage(format!("is not TOML: {problem}{at}; mend it or save it as UTF-8"))
        })?;
        let mut layer = Self::default();
        for (key, value) in flat("", table) {
            layer.push(&key, value, origin.clone()).map_err(|error| {
                Error::Usage(format!("{error}{}", line_of(text, &key).unwrap_or_default()))
            })?;
        }
        Ok(layer)
    }

    /// The settings of a file.
    pub fn load(path: &Path) -> Result<Self> {
        let layer = Self::of_toml(&input::text(path)?, &Origin::File(path.to_owned()));
        layer.map_err(|problem| Error::input(path, problem.to_string()))
    }

    /// Adds `KEY=VALUE`, such as `tone.alpha=0.1`.
    pub fn assign(&mut self, assignment: &str) -> Result<()> {
        let (key, value) = assignment.split_once('=').ok_or_else(|| {
            let problem =
                format!("`{assignment}` has no value; write KEY=VALUE, as in tone.alpha=0.1");
            Error::Usage(problem)
        })?;
        self.set_text(key.trim(), value.trim(), Origin::Set)
    }

    /// Adds a setting with a value as on a command line: TOML, or text without quotes.
    pub fn set_text(&mut self, key: &str, text: &str, origin: Origin) -> Result<()> {
        let value = value(text);
        // A device may be named 0.
        let is_text = setting(key).is_some_and(|row| row.rule.is_text());
        let value = value.filter(|value| !is_text || value.is_str());
        let is_whole = setting(key).is_some_and(|row| matches!(row.rule, Rule::Whole(..)));
        let is_flag = setting(key).is_some_and(|row| matches!(row.rule, Rule::Flag));
        let value = match text {
            "on" | "off" if is_flag => Some((text == "on").into()),
            _ if is_whole => whole(text).map(Value::from).or(value),
            _ => value,
        };
        self.push(key, value.unwrap_or_else(|| Value::String(text.to_owned())), origin)
    }

    /// Adds a setting with its value.
    pub fn push(&mut self, key: &str, value: Value, origin: Origin) -> Result<()> {
        // The constants of a curve can be set one by one.
        let is_part = key.strip_prefix("tone.constants.").is_some_and(|name| !name.contains('.'));
        match setting(key) {
            Some(row) if takes(&row.rule, &value) => {}
            // The nearest name, or what is wrong with a formula.
            Some(Setting { key: Cow::Borrowed("tone.curve"), .. }) if value.is_str() => {
                value.as_str().unwrap_or_default().parse::<Tone>()?;
            }
            Some(row) => return Err(row.refused(value)),
            None if is_part && number(&value).is_some_and(f64::is_finite) => {}
            None => return Err(unknown(key)),
        }
        self.0.push((key.to_owned(), value, origin));
        Ok(())
    }

    /// Every setting of a configuration.
    fn from_config(config: &TrainConfig) -> Result<Self> {
        let table = Table::try_from(config).map_err(|error| Error::Usage(error.to_string()))?;
        let values = flat("", table).into_iter();
        Ok(Self(values.map(|(key, value)| (key, value, Origin::Default)).collect()))
    }

    /// Its keys with their values.
    pub(crate) fn entries(&self) -> impl Iterator<Item = (&str, &Value)> {
        self.0.iter().map(|(key, value, _)| (key.as_str(), value))
    }

    /// Whether it has a setting whose key starts with `section`.
    pub(super) fn names(&self, section: &str) -> bool {
        self.0.iter().any(|(key, ..)| key.starts_with(section))
    }

    /// The value of a setting.
    pub fn get(&self, key: &str) -> Option<&Value> {
        self.0.iter().rev().find_map(|(name, value, _)| (name == key).then_some(value))
    }
}

/// Merged settings with their origins.
#[derive(Clone, Debug, Default)]
pub struct Settings(BTreeMap<String, (Value, Origin)>);

impl Settings {
    pub(super) fn merge(&mut self, layer: &SettingsLayer) {
        // The settings of a curve are applied after the curve, in any order.
        let order = |key: &str| match key {
            "tone.curve" => 0,
            "tone.auto_gain" => 1,
            _ => 2,
        };
        let mut stated: Vec<_> = layer.0.iter().collect();
        stated.sort_by_key(|(key, ..)| order(key));
        for (key, value, origin) in stated {
            self.set(key, value.clone(), origin.clone());
        }
    }

    fn set(&mut self, key: &str, value: Value, origin: Origin) {
        let (mut key, mut value) = (key, value);
        let is_another = self.0.get(key).is_none_or(|(current, _)| *current != value);
        match key {
            "tone.curve" if is_another => {
                self.0.retain(|key, _| {
                    !OF_CURVE.iter().any(|name| key.strip_prefix("tone.") == Some(name))
                });
            }
            "tone.auto_gain" if is_another => drop(self.0.remove("tone.full_resolution")),
            _ => {}
        }
        if let Some(name) = key.strip_prefix("tone.constants.") {
            let mut constants = match self.0.get("tone.constants") {
                Some((Value::Table(constants), _)) => constants.clone(),
                _ => self.constants(),
            };
            constants.insert(name.to_owned(), value);
            (key, value) = ("tone.constants", Value::Table(constants));
        }
        self.0.insert(key.to_owned(), (value, origin));
    }

    /// The curve's own constants.
    fn constants(&self) -> Table {
        let curve = self.0.get("tone.curve").and_then(|(value, _)| value.as_str()?.parse().ok());
        let constants = curve.map_or(&[][..], |curve: ToneCurve| curve.family().constants);
        constants
            .iter()
            .map(|constant| (constant.name.to_string(), constant.default.into()))
            .collect()
    }

    /// The configuration.
    pub(crate) fn config(&self) -> Result<TrainConfig> {
        let mut table = Table::new();
        for (key, (value, _)) in &self.0 {
            let mut path: Vec<&str> = key.split('.').collect();
            let Some(name) = path.pop() else { continue };
            let section = path.into_iter().try_fold(&mut table, |table, name| {
                table.entry(name).or_insert_with(|| Value::Table(Table::new())).as_table_mut()
            });
            if let Some(section) = section {
                section.insert(name.to_owned(), value.clone());
            }
        }
        table.try_into().map_err(|error: toml::de::Error| Error::Usage(error.message().to_owned()))
    }

    /// The origin of a value in words.
    fn origin(&self, row: &Setting) -> String {
        let stated = self.0.get(row.key.as_ref()).map(|(_, origin)| origin.to_string());
        stated
            .or_else(|| row.absent.map(str::to_owned))
            .unwrap_or_else(|| Origin::Default.to_string())
    }

    /// Every setting of a configuration with value, origin and help.
    pub(crate) fn explained(&self, config: &TrainConfig) -> Result<String> {
        let values = values(config)?;
        let line = |row: &Setting| {
            let value = values.get(row.key.as_ref()).map(Value::to_string);
            let value = value.map(|value| format!(" = {value}")).unwrap_or_default();
            format!(
                "{}{value}  ({})\n    {}: {}\n",
                row.key,
                self.origin(row),
                row.help(),
                row.takes()
            )
        };
        Ok(SETTINGS.iter().map(line).collect())
    }

    /// The text of config.toml: every setting with its help and the origin of its value.
    pub(crate) fn written(&self, config: &TrainConfig) -> Result<String> {
        let (mut written, mut section) = (String::new(), String::new());
        for line in config.to_toml()?.lines() {
            if let Some(name) = line.strip_prefix('[').and_then(|line| line.strip_suffix(']')) {
                section = format!("{name}.");
            }
            let key = line.split_once(" = ").map(|(name, _)| format!("{section}{name}"));
            // A value of several lines gets no comment.
            let row = key.and_then(|key| setting(&key)).filter(|_| line.parse::<Table>().is_ok());
            written += &match row {
                Some(row) => {
                    format!("# {}: {}\n{line}  # {}\n", row.help(), row.takes(), self.origin(row))
                }
                None => format!("{line}\n"),
            };
        }
        Ok(written)
    }
}

impl TrainConfig {
    /// Reads a TOML file; settings that it omits keep their defaults.
    ///
    /// # Errors
    /// The file cannot be read, or has an unknown key or an invalid value.
    pub fn load(path: &Path) -> Result<Self> {
        let mut settings = Settings::default();
        settings.merge(&SettingsLayer::load(path)?);
        settings.config().map_err(|problem| Error::input(path, problem.to_string()))
    }

    /// Reads TOML; settings that it omits keep their defaults.
    ///
    /// # Errors
    /// It has an unknown key or an invalid value.
    pub fn from_toml(text: &str) -> Result<Self> {
        let mut settings = Settings::default();
        settings.merge(&SettingsLayer::of_toml(text, &Origin::Default)?);
        settings.config()
    }

    /// The configuration with each `KEY=VALUE` of `assignments` in turn, such as `tone.alpha=0.1`. A value is TOML, or
    /// else a string.
    ///
    /// # Errors
    /// [`Error::Setting`] for an invalid value, [`Error::Usage`] for an unknown key.
    pub fn with(&self, assignments: &[String]) -> Result<Self> {
        let mut layer = SettingsLayer::default();
        assignments.iter().try_for_each(|assignment| layer.assign(assignment))?;
        self.overlaid(&layer)
    }

    /// The configuration with the settings of a layer.
    pub(super) fn overlaid(&self, layer: &SettingsLayer) -> Result<Self> {
        let mut settings = Settings::default();
        settings.merge(&SettingsLayer::from_config(self)?);
        settings.merge(layer);
        let config = settings.config()?;
        Ok(Self { spool: self.spool.clone(), ..config })
    }
}

/// The values in a configuration's TOML, by key.
pub fn values(config: &TrainConfig) -> Result<BTreeMap<String, Value>> {
    Ok(SettingsLayer::from_config(config)?
        .0
        .into_iter()
        .map(|(key, value, _)| (key, value))
        .collect())
}

/// A whole number, also in short forms: 5000, 5k, 1e4, 1.5M.
pub(crate) fn whole(text: &str) -> Option<i64> {
    let factor = |letter| match letter {
        'k' | 'K' => Some(1e3),
        'm' | 'M' => Some(1e6),
        _ => None,
    };
    let factor = text.chars().last().and_then(factor);
    let digits = if factor.is_some() { &text[..text.len() - 1] } else { text };
    let number = digits.parse::<f64>().ok()? * factor.unwrap_or(1.0);
    // Beyond 2^53, not every whole number is a double.
    (number.fract() == 0.0 && number.abs() < 9e15).then_some(number as i64)
}

/// The line of an offset in a text, for messages.
fn line_at(text: &str, at: usize) -> String {
    format!(" (line {})", text[..at].matches('\n').count() + 1)
}

/// The line of a key.
fn line_of(text: &str, key: &str) -> Option<String> {
    let document = DeTable::parse(text).ok()?;
    let (mut table, mut at) = (document.get_ref(), None);
    for name in key.split('.') {
        let Some((name, value)) =
            table.iter().find(|(name_in_file, _)| name_in_file.get_ref() == name)
        else {
            break;
        };
        at = Some(name.span().start);
        match value.get_ref() {
            DeValue::Table(inner) => table = inner,
            _ => break,
        }
    }
    at.map(|at| line_at(text, at))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::Background;
    use nightsplat_photographs::tone::ToneSettings;

    fn with(assignments: &[&str]) -> Result<TrainConfig> {
        let assignments: Vec<String> = assignments.iter().map(|&text| text.to_owned()).collect();
        TrainConfig::default().with(&assignments)
    }

    #[test]
    fn an_assignment_changes_one_setting_and_nothing_else() {
        let config = with(&[
            "tone.alpha=0.25",
            "density.gradient_threshold = 1e-4",
            "downscale=4",
            "background=black",
            "model.raw_colors=on",
            "device=0",
            "schedule.damping_steps=[1, 2]",
            "reference=pictures/high",
            "steps=3",
            "steps=4",
        ])
        .unwrap();
        let mut expected = TrainConfig::default();
        expected.tone.alpha = 0.25;
        expected.density.gradient_threshold = Some(1e-4);
        expected.downscale = 4.0;
        expected.background = Background::Black;
        expected.model.raw_colors = true;
        expected.device = "0".to_owned();
        expected.schedule.damping_steps = [1, 2];
        expected.reference = Some("pictures/high".into());
        expected.steps = 4;
        assert_eq!(config, expected);
        assert_eq!(with(&[]).unwrap(), TrainConfig::default());
    }

    #[test]
    fn a_whole_number_has_short_forms() {
        for (text, number) in [("5k", 5000), ("1e4", 10_000), ("1.5k", 1500), ("2M", 2_000_000)] {
            assert_eq!(with(&[&format!("steps={text}")]).unwrap().steps, number, "{text}");
        }
        for text in ["1.5", "k", "5kk", "many", "1e-1", "nan"] {
            assert!(with(&[&format!("steps={text}")]).is_err(), "{text}");
        }
        assert_eq!(with(&["seed=9007199254740993"]).unwrap().seed, 9_007_199_254_740_993);
    }

    #[test]
    fn another_curve_has_its_own_constants_wherever_the_layer_names_it() {
        let ase = with(&["tone.gain_c=2", "tone.curve=ase"]).unwrap();
        assert_eq!(ase.tone, ToneSettings { gain_c: 2.0, ..ToneSettings::new(ToneCurve::Ase) });
        let mut settings = Settings::default();
        let layer = |text| SettingsLayer::of_toml(text, &Origin::Default).unwrap();
        settings.merge(&layer("[tone]\ncurve = \"ase\"\ngain_c = 2.0\ntheta = 0.4"));
        settings.merge(&layer("[tone]\ncurve = \"ap3\""));
        assert_eq!(
            settings.config().unwrap().tone,
            ToneSettings { theta: 0.4, ..ToneSettings::new(ToneCurve::Ap3) }
        );
    }

    #[test]
    fn a_single_constant_of_a_curve_can_be_set() {
        let family = ToneCurve::ALL.into_iter().find(|curve| !curve.family().constants.is_empty());
        let curve = family.unwrap();
        let name = &curve.family().constants[0].name;
        let config = with(&[
            &format!("tone.curve={}", curve.name()),
            &format!("tone.constants.{name}=0.75"),
        ]);
        assert_eq!(config.unwrap().tone.constants[0], 0.75);
    }

    #[test]
    fn an_error_in_a_file_has_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("config.toml");
        for (text, parts) in [
            ("steps = 3\nstepz = 4\n", ["`stepz`", "(line 2)"]),
            (
                "steps = 3\n[stop]\nviews = 1\nevery = 0\n",
                ["stop.every is 0; it must be a whole number, at least 1", "(line 4)"],
            ),
            ("steps = 3\nseed = \"x\"\n", ["seed is \"x\"", "(line 2)"]),
            ("steps = \n", ["is not TOML", "(line 1)"]),
        ] {
            std::fs::write(&path, text).unwrap();
            let message = TrainConfig::load(&path).unwrap_err().to_string();
            assert!(parts.iter().all(|part| message.contains(part)), "{message}");
        }
    }

    #[test]
    fn a_written_configuration_has_the_origin_of_each_value_and_is_read_back() {
        let mut settings = Settings::default();
        settings.merge(
            &SettingsLayer::of_toml("steps = 700\n[stop]\nviews = 0", &Origin::Preset("fast"))
                .unwrap(),
        );
        let mut set = SettingsLayer::default();
        set.assign("steps=9").unwrap();
        set.assign("device=a\nb").unwrap();
        settings.merge(&set);
        let config = settings.config().unwrap();
        let text = settings.written(&config).unwrap();
        for line in [
            "\nsteps = 9  # --set\n",
            "\nviews = 0  # preset fast\n",
            "\nseed = 10  # default\n",
            "\n# Training steps (iterations), one view each: a whole number, at least 1, in steps\n",
        ] {
            assert!(text.contains(line), "no {line} in {text}");
        }
        assert_eq!(TrainConfig::from_toml(&text).unwrap(), config);
        let explained = settings.explained(&config).unwrap();
        assert!(
            explained.contains("stop.views = 0  (preset fast)\n    Hold out this many"),
            "{explained}"
        );
        assert!(explained.contains("cache  (a quarter of each memory)\n"), "{explained}");
    }
}
