//! Options of a training. Those that set a single setting come from the table of settings; the others are defined here.

use std::path::{Path, PathBuf};

use clap::{Args, ValueHint};
use nightsplat_photographs::dataset::exclude;
use nightsplat_photographs::scene_tone::SceneTone;
use toml::Value;

use crate::cli::settings::{
    CurveOptions, Selection, SettingOptions, push_curve, push_dataset, push_targets,
};
use crate::cli::words::{self, NamedValues};
use crate::train::plan::Plan;
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
    single: SettingOptions<OfTraining>,
}

/// Every setting with an option, without those of [`CurveOptions`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct OfTraining;

impl Selection for OfTraining {
    fn has(key: &str) -> bool {
        !["tone.curve", "tone.gain_c"].contains(&key)
    }
}

/// The options that set several settings.
#[derive(Clone, Debug, Default, Args)]
struct SeveralSettings {
    #[command(flatten)]
    curve: CurveOptions,
    /// Folder of targets that another program made, by the names of the photographs and of their size, in any format
    /// that photographs have; there is no curve then, and no linear light
    #[arg(long, value_name = "DIR", value_hint = ValueHint::AnyPath, conflicts_with_all = OF_CURVES)]
    targets: Option<PathBuf>,
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
    #[arg(long, value_parser = NamedValues::<ModelName>::new(["plain", "lita"]))]
    model: Option<ModelName>,
    /// Parts of the model: any of denoiser, tonemapper, structure, depth, lamp, normals
    #[arg(long, value_name = "LIST", value_delimiter = ',', value_parser = words::parts())]
    parts: Option<Vec<Part>>,
    /// draft, fast, balanced or best: quality for time; paper: the paper's curve and length; lom, realx3d or
    /// mip360-varying: the paper's benchmarks [default: balanced]
    #[arg(long, value_name = "NAME", value_parser = words::presets())]
    preset: Option<Preset>,
}

/// What targets of another program have none of.
const OF_CURVES: [&str; 7] = ["curve", "profile", "gain", "brightness", "colour", "theta", "law"];

/// What `--frame` sets.
const OF_FRAME: [&str; 5] = ["frame.center", "frame.scale", "extent", "up", "near"];

impl TrainOptions {
    /// Whether the command line gives a setting.
    pub(in crate::cli) fn gives(&self, key: &str) -> bool {
        self.single.get(key).is_some()
    }

    /// These options without that of a setting.
    pub(in crate::cli) fn without(&self, key: &str) -> Self {
        let mut options = self.clone();
        options.single.remove(key);
        options
    }

    /// A warning for each option without effect under `config`.
    pub(super) fn idle(&self, config: &TrainConfig) -> Vec<String> {
        let of_parts = |key: &str| -> &[Part] {
            match key {
                "model.denoiser_crop" => &[Part::Denoiser, Part::Tonemapper],
                "model.depth_folder" | "model.depth_is_disparity" => &[Part::Depth],
                "model.normal_folder" => &[Part::Normals],
                _ if key.starts_with("model.network.") => &[Part::Denoiser],
                _ => &[],
            }
        };
        let mut lines = vec![];
        for (row, _) in self.single.given() {
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
        push_dataset(options, dataset)?;
        several.push_excluded(options)?;
        several.push_frame(options)?;
        several.curve.push(options)?;
        several.targets.iter().try_for_each(|folder| push_targets(options, folder))?;
        self.push_law(options)?;
        several.push_parts(options)?;
        if self.gives("exposure.start") {
            options.push("exposure.learn", true.into(), Origin::Option("--exposures"))?;
        }
        self.single.push(options)?;
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
        let Some(path) = self.single.get("tone.law") else { return Ok(()) };
        push_curve(options, SceneTone::load(Path::new(path))?.settings().clone(), "--law")
    }
}

impl SeveralSettings {
    fn push_frame(&self, options: &mut SettingsLayer) -> Result<()> {
        let Some(path) = &self.frame else { return Ok(()) };
        for (key, value) in SettingsLayer::load(path)?.entries() {
            if !OF_FRAME.contains(&key) {
                let keys = OF_FRAME.join(", ");
                return Err(Error::input(path, format!("sets {key}; a frame has {keys} only")));
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
