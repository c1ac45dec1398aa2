//! Options that set settings: those of a single setting come from its row, those of the tone curve are defined here.

use std::marker::PhantomData;
use std::ops::Bound;
use std::path::{Path, PathBuf};

use clap::builder::ValueParser;
use clap::{Arg, ArgAction, ArgMatches, Args, Command, FromArgMatches, ValueHint};
use nightsplat_core::settings::{Rule, Setting};
use nightsplat_photographs::tone::{CurveChoice, Profile, Tone, ToneSettings};
use toml::{Table, Value};

use super::words::{self, NamedValues};
use crate::train::settings::SETTINGS;
use crate::train::{Origin, SettingsLayer};
use crate::{Error, Result};

/// Which settings a command has options for.
pub(super) trait Selection {
    /// Whether the setting is one of them.
    fn has(key: &str) -> bool;
}

/// The options of the selected settings, with their values as text.
#[derive(Clone, Debug)]
pub(super) struct SettingOptions<S> {
    given: Vec<(&'static Setting, String)>,
    selection: PhantomData<fn() -> S>,
}

impl<S> Default for SettingOptions<S> {
    fn default() -> Self {
        Self { given: vec![], selection: PhantomData }
    }
}

impl<S: Selection> SettingOptions<S> {
    /// The rows with names of option and value.
    fn rows() -> impl Iterator<Item = (&'static Setting, &'static str, Option<&'static str>)> {
        let rows = SETTINGS.iter().filter(|row| S::has(&row.key));
        rows.filter_map(|row| row.option().map(|(name, value)| (row, name, value)))
    }

    /// The settings that the command line gives, with their values.
    pub(super) fn given(&self) -> &[(&'static Setting, String)] {
        &self.given
    }

    /// The value of a setting that the command line gives.
    pub(super) fn get(&self, key: &str) -> Option<&str> {
        self.given.iter().find_map(|(row, text)| (row.key == key).then_some(text.as_str()))
    }

    /// Leaves out the option of a setting.
    pub(super) fn remove(&mut self, key: &str) {
        self.given.retain(|(row, _)| row.key != key);
    }

    /// Adds what the command line gives.
    pub(super) fn push(&self, layer: &mut SettingsLayer) -> Result<()> {
        for (row, text) in &self.given {
            let origin = Origin::Option(
                row.option.and_then(|option| option.split(' ').next()).unwrap_or_default(),
            );
            match (row.key.as_ref(), text.as_str()) {
                ("max_resolution", "none") => layer.push(&row.key, 0.into(), origin)?,
                (key, text) => layer.set_text(key, text, origin)?,
            }
        }
        Ok(())
    }
}

/// The options that a tone law sets.
const OF_LAW: [&str; 7] =
    ["curve", "profile", "gain", "brightness", "colour", "theta", "scene-statistics"];

impl<S: Selection> Args for SettingOptions<S> {
    fn augment_args(command: Command) -> Command {
        Self::rows().fold(command, |command, (row, name, value)| {
            let arg = Arg::new(name).long(name).help(help(row));
            // The name in other trainers.
            let arg = if name == "steps" { arg.visible_alias("iterations") } else { arg };
            let arg = if name == "law" { arg.conflicts_with_all(OF_LAW) } else { arg };
            let is_path = matches!(row.rule, Rule::Text("a path", _));
            let arg = if is_path { arg.value_hint(ValueHint::AnyPath) } else { arg };
            command.arg(match (value, row.rule) {
                (Some(value), Rule::OneOf(words)) => {
                    let words = words.iter().copied();
                    arg.value_name(value).value_parser(NamedValues::<String>::new(words))
                }
                (Some(value), _) => arg.value_name(value).value_parser(ValueParser::string()),
                (None, _) => arg.action(ArgAction::SetTrue),
            })
        })
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl<S: Selection> FromArgMatches for SettingOptions<S> {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let given = |(row, name, value): (&'static Setting, &'static str, Option<&str>)| {
            let text = match value {
                Some(_) => matches.get_one::<String>(name).cloned(),
                None => matches.get_flag(name).then(|| "true".to_owned()),
            };
            Some((row, text?))
        };
        Ok(Self { given: Self::rows().filter_map(given).collect(), ..Self::default() })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

/// The help of an option: effect, range and default of its setting.
fn help(row: &Setting) -> String {
    let default = match row.absent {
        Some(absent) => absent.to_owned(),
        None if matches!(row.rule, Rule::Flag) => return row.help(),
        None => format!("{{{}}}", row.key),
    };
    let range = match row.rule {
        Rule::Number(_, Bound::Included(most)) if most < 1e6 => format!(", {}", row.rule),
        Rule::Whole(_, most) if most < u32::MAX.into() => format!(", {}", row.rule),
        _ => String::new(),
    };
    format!("{}{range} [default: {default}]", row.help())
}

/// The options that set several settings of the tone curve.
#[expect(clippy::doc_markdown, reason = "in help, {setting} stands for its default")]
#[derive(Clone, Debug, Default, Args)]
pub(super) struct CurveOptions {
    /// Tone curve: a name from `nightsplat tone list`, a formula of t = x / p90 or of x with constants, such as
    /// 'a*t/(t+b); a = 1.2; b = 0.3', or a .toml, .csv or .cube file [default: {tone.curve}]
    #[arg(long, value_name = "NAME|FORMULA|FILE", value_parser = words::curves::<CurveChoice>())]
    pub(super) curve: Option<CurveChoice>,
    /// Camera profile from `nightsplat tone fit --profile`, in place of a curve; scores are marked, as they depend on
    /// its references
    #[arg(long, value_name = "FILE", conflicts_with_all = ["curve", "gain", "brightness", "colour", "theta"])]
    pub(super) profile: Option<PathBuf>,
    /// Gain constant c of the curve, or auto to measure the gain, as the curve auto does [default: {tone.gain_c of
    /// ase} for ase, {tone.gain_c of ap3} for ap3, else {tone.gain_c of linear}]
    #[arg(long, value_name = "C|auto", value_parser = gain)]
    pub(super) gain: Option<Gain>,
}

/// The gain per mean luminance of a photograph; `None`: the gain is measured.
type Gain = Option<f64>;

fn gain(text: &str) -> Result<Gain, String> {
    let wrong = |_| format!("`{text}` is not a gain; use a number, or auto");
    if text == "auto" { Ok(None) } else { text.parse().map(Some).map_err(wrong) }
}

impl CurveOptions {
    /// The name of the curve.
    pub(super) fn name(&self) -> String {
        match (&self.profile, &self.curve) {
            (Some(_), _) => "profile".to_owned(),
            (None, Some(curve)) => curve.to_string(),
            (None, None) => ToneSettings::default().curve.to_string(),
        }
    }

    /// Adds what the command line gives.
    pub(super) fn push(&self, layer: &mut SettingsLayer) -> Result<()> {
        let from_file = match (&self.curve, &self.profile) {
            (_, Some(file)) => {
                Some((ToneSettings::new(Tone::Profile(Profile::load(file)?)), "--profile"))
            }
            (Some(CurveChoice::Named(curve)), _) => {
                layer.push("tone.curve", curve.to_string().into(), Origin::Option("--curve"))?;
                None
            }
            (Some(file), _) => {
                let settings = file.settings()?;
                let with_gain = self.gain.map(|gain| settings.clone().with_gain(gain));
                Some((with_gain.unwrap_or(settings), "--curve"))
            }
            (None, None) => None,
        };
        if let Some((settings, option)) = from_file {
            return push_curve(layer, settings, option);
        }
        let Some(gain) = self.gain else { return Ok(()) };
        let mut say = |key: &str, value: Value| layer.push(key, value, Origin::Option("--gain"));
        say("tone.auto_gain", gain.is_none().into())?;
        gain.map_or(Ok(()), |gain| say("tone.gain_c", gain.into()))
    }
}

/// Adds every setting of a curve.
pub(super) fn push_curve(
    layer: &mut SettingsLayer,
    curve: ToneSettings,
    option: &'static str,
) -> Result<()> {
    let table = Table::try_from(curve).map_err(|error| Error::Usage(error.to_string()))?;
    table.into_iter().try_for_each(|(name, value)| {
        layer.push(&format!("tone.{name}"), value, Origin::Option(option))
    })
}

/// Adds the targets that another program made, which no curve makes.
pub(super) fn push_targets(layer: &mut SettingsLayer, folder: &Path) -> Result<()> {
    let text = folder
        .to_str()
        .ok_or_else(|| Error::input(folder, "is not Unicode; move it to a path that is"))?;
    layer.push("tone.curve", "targets".into(), Origin::Option("--targets"))?;
    layer.push("tone.targets", text.into(), Origin::Option("--targets"))
}

/// Adds the dataset that the command line names.
pub(super) fn push_dataset(layer: &mut SettingsLayer, dataset: &Path) -> Result<()> {
    let text = dataset
        .to_str()
        .ok_or_else(|| Error::input(dataset, "is not Unicode; move it to a path that is"))?;
    layer.push("dataset", text.into(), Origin::Option("argument"))
}
