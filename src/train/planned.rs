//! The configuration that `nightsplat train` trains, from requested settings and a plan.

use std::path::Path;

use nightsplat_photographs::dataset::{Dataset, LoadOptions};
use nightsplat_photographs::external_targets::ExternalTargets;
use nightsplat_photographs::tone::Tone;
use toml::Value;

use super::config::TrainConfig;
use super::layers::{Origin, Settings, SettingsLayer};
use super::passes::while_compiling;
use super::plan::{Plan, PlannedPart};
use super::preset::Preset;
use super::trainer::Trainer;
use crate::gpu::Gpu;
use crate::{Error, Result};
use nightsplat_diagnose::Diagnosis;

/// Requested settings of a run in addition to its plan, from the lowest precedence to the highest.
#[derive(Clone, Debug, Default)]
pub struct RequestedSettings {
    /// The preset; `None`: the defaults, which are balanced.
    pub preset: Option<Preset>,
    /// A configuration file.
    pub file: SettingsLayer,
    /// Options.
    pub options: SettingsLayer,
    /// `--set`.
    pub set: SettingsLayer,
}

/// The source of settings that are not requested.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlanSource<'a> {
    /// None: the preset's values.
    Nothing,
    /// The plan in this file.
    File(&'a Path),
    /// A diagnosis of the photographs.
    Diagnosis,
}

/// A run with all settings decided.
#[derive(Debug)]
pub struct PlannedRun {
    /// Its configuration.
    pub config: TrainConfig,
    /// The origin of each value.
    pub settings: Settings,
    /// The plan, with its reasons.
    pub plan: Option<Plan>,
    /// The dataset, without the views that the plan leaves out.
    pub dataset: Dataset,
}

impl RequestedSettings {
    /// The requested settings, completed by a plan.
    pub fn settings(&self, plan: Option<&Plan>) -> Result<Settings> {
        let requested = [&self.file, &self.options, &self.set];
        let get = |key: &str| requested.iter().rev().find_map(|layer| layer.get(key));
        let mut settings = Settings::default();
        if let Some(preset) = self.preset {
            let curve = get("tone.curve").and_then(Value::as_str);
            let dataset = get("dataset").and_then(Value::as_str).unwrap_or_default();
            settings.merge(&preset.layer(curve, Path::new(dataset))?);
        }
        if let Some(plan) = plan {
            // Any requested tone setting decides the curve.
            let names_a_curve = requested.iter().any(|layer| layer.names("tone."));
            let automatic = Value::from(Tone::Auto.name());
            let is_automatic = get("tone.curve").is_none_or(|curve| *curve == automatic)
                && get("tone.brightness").is_none();
            // Exposures and the tonemapper exclude each other, and a plan never enables both.
            let has_tonemapper = get("model.tonemapper") == Some(&Value::Boolean(true));
            let mut layer = plan.layer()?;
            layer.0.retain(|(key, ..)| match key.as_str() {
                "tone.curve" => !names_a_curve,
                // Other targets have a grey sky.
                "background" => is_automatic,
                "exposure.learn" => !has_tonemapper,
                _ => true,
            });
            settings.merge(&layer);
        }
        // A gain of each photograph would follow the lamp.
        let has_lamp = get("model.lamp").map_or_else(
            || plan.is_some_and(|plan| plan.lamp.on),
            |requested| requested == &Value::Boolean(true),
        );
        if has_lamp {
            let mut layer = SettingsLayer::default();
            layer.push("tone.scene_statistics", true.into(), Origin::Lamp)?;
            settings.merge(&layer);
        }
        for layer in requested {
            settings.merge(layer);
        }
        Ok(settings)
    }

    /// Loads the dataset and plans what is not requested.
    pub fn planned(&self, planning: PlanSource<'_>, gpu: &Gpu) -> Result<PlannedRun> {
        let _phase = tracing::info_span!("plan").entered();
        let config = self.settings(None)?.config()?;
        config.check()?;
        let mut options = match planning {
            PlanSource::Nothing => config.load_options(),
            _ => diagnosed(&config),
        };
        if let PlanSource::File(file) = planning {
            let Plan { falloff, bands, .. } = Plan::read(file)?;
            options.falloff = options.falloff.or(falloff.on.then_some(falloff.falloff));
            options.bands = options.bands.or(bands.on.then_some(bands.rows));
        }
        let (mut dataset, plan) = while_compiling(gpu, &config, || {
            if planning == PlanSource::Diagnosis {
                let (dataset, diagnosis) = Diagnosis::load(&config.dataset, &options)?;
                Ok((dataset, Some(planned(&diagnosis, &config, gpu))))
            } else {
                Ok((Dataset::load(&config.dataset, &options)?, None))
            }
        })?;
        let mut plan = match planning {
            PlanSource::File(file) => Some(Plan::load(file, &dataset)?),
            _ => plan,
        };
        if let Some(folder) = config.tone.targets() {
            let found = ExternalTargets::check(folder, &dataset)?;
            match &mut plan {
                Some(plan) => plan.curve = PlannedPart { on: false, why: found.sentence() },
                None => tracing::info!("{}", found.sentence()),
            }
            if let Some(problem) = found.problem() {
                tracing::warn!("{}: {problem}", folder.display());
            }
        }
        if let Some(plan) = &plan {
            dataset.leave_out(&plan.left_out);
        }
        let settings = self.settings(plan.as_ref())?;
        let config = settings.config()?;
        config.check()?;
        Ok(PlannedRun { config, settings, plan, dataset })
    }
}

/// The configuration's load options, with depth maps, whose presence is part of the diagnosis.
pub fn diagnosed(config: &TrainConfig) -> LoadOptions {
    let mut options = config.load_options();
    options.depth.load = true;
    options
}

/// The plan from a diagnosis, whose remarks are logged.
fn planned(diagnosis: &Diagnosis, config: &TrainConfig, gpu: &Gpu) -> Plan {
    for remark in &diagnosis.remarks {
        tracing::warn!("{remark}");
    }
    Plan::new(diagnosis, config, gpu.properties().memory)
}

impl Preset {
    /// The options to load a dataset for [`Trainer::planned`], as `nightsplat train --preset` does.
    ///
    /// # Errors
    /// Never.
    pub fn load_options(self) -> Result<LoadOptions> {
        let config = RequestedSettings { preset: Some(self), ..RequestedSettings::default() }
            .settings(None)?
            .config()?;
        Ok(if self.is_planned() { diagnosed(&config) } else { config.load_options() })
    }
}

impl Trainer {
    /// A trainer on the dataset in a folder, with settings in the format of config.toml; a diagnosis of the photographs
    /// decides the rest.
    #[doc(hidden)]
    pub fn with_settings(gpu: &Gpu, dataset: &str, toml: &str) -> Result<Self> {
        let file = SettingsLayer::of_toml(toml, &Origin::Default)?;
        let mut requested = RequestedSettings { file, ..RequestedSettings::default() };
        requested.options.push("dataset", dataset.into(), Origin::Option("dataset"))?;
        let run = requested.planned(PlanSource::Diagnosis, gpu)?;
        Self::new(gpu, run.config, &run.dataset)
    }

    /// A trainer as of `nightsplat train --preset`: the photographs are diagnosed, unless the preset sets everything.
    /// `dataset` must be loaded with [`Preset::load_options`].
    ///
    /// # Errors
    /// The dataset cannot be used, or the device is out of memory or lost.
    pub fn planned(gpu: &Gpu, dataset: &Dataset, preset: Preset) -> Result<Self> {
        let mut requested =
            RequestedSettings { preset: Some(preset), ..RequestedSettings::default() };
        let root = dataset.root.to_str().ok_or_else(|| {
            Error::input(&dataset.root, "is not Unicode; move it to a path that is")
        })?;
        requested.options.push("dataset", root.into(), Origin::Option("dataset"))?;
        let config = requested.settings(None)?.config()?;
        if !preset.is_planned() {
            return Self::new(gpu, config, dataset);
        }
        let plan = planned(&Diagnosis::new(dataset, &diagnosed(&config))?, &config, gpu);
        let mut dataset = dataset.clone();
        dataset.leave_out(&plan.left_out);
        Self::new(gpu, requested.settings(Some(&plan))?.config()?, &dataset)
    }
}
