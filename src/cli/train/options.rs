//! Options of a training. Those that set a single setting come from the table of settings; the others are defined here.

use std::ops::Bound;
use std::path::{Path, PathBuf};

use clap::builder::ValueParser;
use clap::{Arg, ArgAction, ArgMatches, Args, Command, FromArgMatches, ValueHint};
use toml::{Table, Value};

use crate::base::settings::{Rule, Setting};
use crate::cli::words::{self, Words};
use crate::photographs::dataset::exclude;
use crate::photographs::targets::SceneTone;
use crate::photographs::tone::{CurveChoice, GainChoice, Profile, Tone, ToneSettings};
use crate::train::diagnose::Plan;
use crate::train::settings::SETTINGS;
use crate::train::{
    ModelName, Origin, Part, Preset, RequestedSettings, SettingsLayer, TrainConfig,
};
use crate::{Error, Result};

/// Options of a run; each overrides the configuration file.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct TrainOptions {
    #[command(flatten)]
    several: SeveralSettings,
    #[command(flatten)]
    single: SingleSettings,
}

/// The options that set several settings.
#[expect(clippy::doc_markdown, reason = "in help, {setting} stands for its default")]
#[derive(Clone, Debug, Default, Args)]
struct SeveralSettings {
    /// Tone curve: a name from `nightsplat tone list`, or a .toml, .csv or .cube file [default: {tone.curve}]
    #[arg(long, value_name = "NAME|FILE", value_parser = words::curves::<CurveChoice>())]
    curve: Option<CurveChoice>,
    /// Camera profile from `nightsplat tone fit --profile`, in place of a curve; scores are marked, as they depend on
    /// its references
    #[arg(long, value_name = "FILE", conflicts_with_all = ["curve", "gain", "brightness", "colour", "theta"])]
    profile: Option<PathBuf>,
    /// Gain constant c of the curve, or auto to measure the gain, as the curve auto does [default: {tone.gain_c of
    /// ase} for ase, {tone.gain_c of ap3} for ap3, else {tone.gain_c of linear}]
    #[arg(long, value_name = "C|auto")]
    gain: Option<GainChoice>,
    /// TOML file with settings, such as the config.toml of a run
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// TOML file with the frame of a scene in place of what the cameras show: frame.center, frame.scale, extent, up and
    /// near, as `nightsplat blocks plan` writes it
    #[arg(long, value_name = "FILE")]
    frame: Option<PathBuf>,
    /// Set any key of config.toml, such as tone.alpha=0.1; repeatable, overrides everything else
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Leave out photographs by name or path, with `*`, `?` and `[abc]`; repeatable
    #[arg(long, value_name = "GLOB")]
    exclude: Vec<String>,
    /// Leave out the photographs that a file names or matches, one a line
    #[arg(long, value_name = "FILE")]
    exclude_file: Option<PathBuf>,
    /// plain: 3DGS; lita: all parts of LITA-GS, with L1 alone on R_0 [default: plain]
    #[arg(long, value_parser = Words::<ModelName>::new(["plain", "lita"]))]
    model: Option<ModelName>,
    /// Parts of the model: any of denoiser, tonemapper, structure, depth
    #[arg(long, value_name = "LIST", value_delimiter = ',', value_parser = words::parts())]
    parts: Option<Vec<Part>>,
    /// draft, fast, balanced or best: quality for time; paper: the paper's curve and length; lom, realx3d or
    /// mip360-varying: the paper's benchmarks [default: balanced]
    #[arg(long, value_name = "NAME", value_parser = words::presets())]
    preset: Option<Preset>,
}

/// The options that a tone law sets.
const OF_LAW: [&str; 6] = ["curve", "profile", "gain", "brightness", "colour", "theta"];

/// What `--frame` sets.
const OF_FRAME: [&str; 5] = ["frame.center", "frame.scale", "extent", "up", "near"];

/// The options that set a single setting, with their values as text.
#[derive(Clone, Debug, Default)]
struct SingleSettings(Vec<(&'static Setting, String)>);

impl SingleSettings {
    /// The rows with an option, without those of [`SeveralSettings`].
    fn rows() -> impl Iterator<Item = (&'static Setting, &'static str, Option<&'static str>)> {
        let rows =
            SETTINGS.iter().filter_map(|row| row.option().map(|(name, value)| (row, name, value)));
        rows.filter(|(_, name, _)| !["curve", "gain"].contains(name))
    }
}

impl Args for SingleSettings {
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
                    arg.value_name(value).value_parser(Words::<String>::new(words))
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

impl FromArgMatches for SingleSettings {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let given = |(row, name, value): (&'static Setting, &'static str, Option<&str>)| {
            let text = match value {
                Some(_) => matches.get_one::<String>(name).cloned(),
                None => matches.get_flag(name).then(|| "true".to_owned()),
            };
            Some((row, text?))
        };
        Ok(Self(Self::rows().filter_map(given).collect()))
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

impl TrainOptions {
    /// Whether the command line gives a setting.
    pub(in crate::cli) fn gives(&self, key: &str) -> bool {
        self.single.0.iter().any(|(row, _)| row.key == key)
    }

    /// These options without that of a setting.
    pub(in crate::cli) fn without(&self, key: &str) -> Self {
        let mut options = self.clone();
        options.single.0.retain(|(row, _)| row.key != key);
        options
    }

    /// A warning for each option without effect under `config`.
    pub(super) fn idle(&self, config: &TrainConfig) -> Vec<String> {
        let of_parts = |key: &str| -> &[Part] {
            match key {
                "model.denoiser_crop" => &[Part::Denoiser, Part::Tonemapper],
                "model.depth_folder" | "model.depth_is_disparity" => &[Part::Depth],
                _ if key.starts_with("model.network.") => &[Part::Denoiser],
                _ => &[],
            }
        };
        let mut lines = vec![];
        for (row, _) in &self.single.0 {
            let parts = of_parts(&row.key);
            if let (Some(first), Some((option, _))) = (parts.first(), row.option())
                && !parts.iter().any(|&part| config.model.has(part))
            {
                let names: Vec<&str> = parts.iter().map(|part| part.name()).collect();
                lines.push(format!(
                    "--{option} has no effect: the model has no {}; --parts {} adds it",
                    names.join(" and no "),
                    first.name()
                ));
            }
        }
        if config.check.stops && config.check.every == 0 {
            lines.push(
                "--check-stops has no effect: no step is checked; add --check-every N".to_owned(),
            );
        }
        let stop = &config.stop;
        let gains = [("growth_gain", stop.growth_gain), ("degree_gain", stop.degree_gain)];
        let idle = gains.into_iter().filter(|(_, gain)| stop.views == 0 && *gain > 0.0);
        lines.extend(idle.map(|(gain, _)| {
            format!(
                "stop.{gain} has no effect: no views are held out; --set stop.views=N holds out N"
            )
        }));
        lines
    }

    /// Whether a diagnosis of the photographs chooses the settings that no option gives.
    pub(in crate::cli) fn wants_a_plan(&self) -> bool {
        let Self { several, .. } = self;
        several.config.is_none() && several.preset.is_none_or(Preset::is_planned)
    }

    /// The configuration: options first, then the plan, then defaults.
    pub(crate) fn config(&self, dataset: &Path, plan: Option<&Plan>) -> Result<TrainConfig> {
        let config = self.requested(dataset)?.settings(plan)?.config()?;
        config.check()?;
        Ok(config)
    }

    /// The settings that the command line and its files give.
    pub(crate) fn requested(&self, dataset: &Path) -> Result<RequestedSettings> {
        let several = &self.several;
        let mut requested =
            RequestedSettings { preset: several.preset, ..RequestedSettings::default() };
        if let Some(file) = &several.config {
            requested.file = SettingsLayer::load(file)?;
        }
        for assignment in &several.set {
            requested.set.assign(assignment)?;
        }
        let options = &mut requested.options;
        let dataset = dataset
            .to_str()
            .ok_or_else(|| Error::input(dataset, "is not Unicode; move it to a path that is"))?;
        options.push("dataset", dataset.into(), Origin::Option("argument"))?;
        several.push_excluded(options)?;
        several.push_frame(options)?;
        several.push_tone(options)?;
        self.push_law(options)?;
        several.push_parts(options)?;
        if self.gives("exposure.start") {
            options.push("exposure.learn", "on".into(), Origin::Option("--exposures"))?;
        }
        for (row, text) in &self.single.0 {
            let origin = Origin::Option(
                row.option.and_then(|option| option.split(' ').next()).unwrap_or_default(),
            );
            match (row.key.as_ref(), text.as_str()) {
                ("max_resolution", "none") => options.push(&row.key, 0.into(), origin)?,
                (key, text) => options.say(key, text, origin)?,
            }
        }
        if self.gives("steps") {
            // An explicit length switches early stopping off, and with it the held-out views.
            options.push("stop.views", 0.into(), Origin::Option("--steps"))?;
        }
        Ok(requested)
    }
}

impl TrainOptions {
    /// The curve of the tone law, which its photographs were measured for.
    fn push_law(&self, options: &mut SettingsLayer) -> Result<()> {
        let law = self.single.0.iter().find(|(row, _)| row.key == "tone.law");
        let Some((_, path)) = law else { return Ok(()) };
        let scene = SceneTone::load(Path::new(path))?;
        push_curve(options, scene.settings().clone(), "--law")
    }
}

/// Every setting of a curve.
fn push_curve(
    options: &mut SettingsLayer,
    curve: ToneSettings,
    option: &'static str,
) -> Result<()> {
    let table = Table::try_from(curve).map_err(|error| Error::Usage(error.to_string()))?;
    table.into_iter().try_for_each(|(name, value)| {
        options.push(&format!("tone.{name}"), value, Origin::Option(option))
    })
}

impl SeveralSettings {
    fn push_frame(&self, options: &mut SettingsLayer) -> Result<()> {
        let Some(path) = &self.frame else { return Ok(()) };
        for (key, value) in SettingsLayer::load(path)?.entries() {
            if !OF_FRAME.contains(&key) {
                let known = OF_FRAME.join(", ");
                return Err(Error::input(path, format!("sets {key}; a frame has {known} only")));
            }
            options.push(key, value.clone(), Origin::Option("--frame"))?;
        }
        Ok(())
    }

    fn push_excluded(&self, options: &mut SettingsLayer) -> Result<()> {
        let mut patterns = self.exclude.clone();
        if let Some(file) = &self.exclude_file {
            patterns.extend(exclude::patterns_of(file)?);
        }
        if patterns.is_empty() {
            return Ok(());
        }
        let patterns: Vec<Value> = patterns.into_iter().map(Value::String).collect();
        options.push("exclude", Value::Array(patterns), Origin::Option("--exclude"))
    }

    fn push_tone(&self, options: &mut SettingsLayer) -> Result<()> {
        let from_file = match (&self.curve, &self.profile) {
            (_, Some(file)) => {
                Some((ToneSettings::new(Tone::Profile(Profile::load(file)?)), "--profile"))
            }
            (Some(CurveChoice::Named(curve)), _) => {
                options.push("tone.curve", curve.name().into(), Origin::Option("--curve"))?;
                None
            }
            (Some(file), _) => {
                let settings = file.settings()?;
                let gain = |gain| settings.clone().with_gain(gain);
                Some((self.gain.map_or_else(|| settings.clone(), gain), "--curve"))
            }
            (None, None) => None,
        };
        if let Some((settings, option)) = from_file {
            return push_curve(options, settings, option);
        }
        let mut say = |key: &str, value: Value| options.push(key, value, Origin::Option("--gain"));
        match self.gain {
            Some(GainChoice::Auto) => say("tone.auto_gain", true.into()),
            Some(GainChoice::C(gain)) => {
                say("tone.auto_gain", false.into())?;
                say("tone.gain_c", gain.into())
            }
            None => Ok(()),
        }
    }

    fn push_parts(&self, options: &mut SettingsLayer) -> Result<()> {
        let mut set_parts = |parts: &[Part], option| {
            Part::ALL.into_iter().try_for_each(|part| {
                let key = format!("model.{}", part.name());
                options.push(&key, parts.contains(&part).into(), Origin::Option(option))
            })
        };
        match self.model {
            Some(ModelName::Plain) => set_parts(&[], "--model")?,
            Some(ModelName::Lita) => set_parts(&Part::LITA, "--model")?,
            None => {}
        }
        if let Some(parts) = &self.parts {
            set_parts(parts, "--parts")?;
        }
        // Benchmarks state the weight themselves.
        if self.model == Some(ModelName::Lita) && !self.preset.is_some_and(Preset::is_benchmark) {
            options.push("ssim_weight", Value::Float(0.0), Origin::Option("--model"))?;
        }
        Ok(())
    }
}
