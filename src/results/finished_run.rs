//! A run, finished or interrupted, or a model file, opened for rendering by `eval`, `render` and others.

use std::ffi::OsStr;
use std::path::Path;

use nightsplat_models::gaussians::{Gaussians, ModelFacts};
use nightsplat_photographs::dataset::Dataset;
use nightsplat_photographs::tone::{ToneCurve, ToneSettings};

use crate::gpu::{DeviceChoice, Gpu};
use crate::results::eval::ModelRenderer;
use crate::results::{models, run};
use crate::splats::model::Model;
use crate::train::TrainConfig;
use crate::{Error, Result};

/// The device of a command, and how it is opened.
#[derive(Clone, Debug)]
pub(crate) struct Opener {
    /// `None`: the run's.
    pub(crate) device: Option<DeviceChoice>,
    pub(crate) open: fn(&DeviceChoice) -> Result<Gpu>,
}

impl Opener {
    /// Opens the device for a run.
    pub(crate) fn open(&self, config: &TrainConfig) -> Result<Gpu> {
        match &self.device {
            Some(device) => (self.open)(device),
            None => (self.open)(&config.device.parse()?),
        }
    }
}

/// The model of a run with its dataset.
pub(crate) struct FinishedRun {
    pub(crate) gpu: Gpu,
    pub(crate) config: TrainConfig,
    pub(crate) dataset: Dataset,
    pub(crate) gaussian_count: usize,
    /// Evenly lit.
    pub(crate) model_renderer: ModelRenderer,
    /// Whether the targets are known: those of a run, or of a file that states them.
    pub(crate) states_targets: bool,
}

impl FinishedRun {
    /// Loads configuration, model and dataset; dataset and device default to the run's. Warns if the run is incomplete
    /// or the dataset has changed.
    pub(crate) fn open(folder: &Path, dataset: Option<&Path>, opener: &Opener) -> Result<Self> {
        Self::open_with(folder, dataset, opener, |_| {})
    }

    /// [`Self::open`] with a change of the configuration.
    pub(crate) fn open_with(
        folder: &Path,
        dataset: Option<&Path>,
        opener: &Opener,
        change: impl FnOnce(&mut TrainConfig),
    ) -> Result<Self> {
        if is_model(folder) {
            return Self::open_model(folder, dataset, opener, change);
        }
        let mut config = run::load_config(folder)?;
        if let Some(dataset) = dataset {
            config.move_dataset(dataset);
        }
        let trained_at = config.downscale;
        change(&mut config);
        // At another size, every view is another one.
        let is_comparable = config.downscale == trained_at;
        let facts = config.facts(&config.frame.unwrap_or_default());
        let model = Model::of_shown(run::load_gaussians(folder)?, &facts);
        if !config.dataset.is_dir() {
            let problem = format!(
                "names the dataset {}, which does not exist; pass --dataset, or correct `dataset` in this file",
                config.dataset.display()
            );
            return Err(Error::input(folder.join("config.toml"), problem));
        }
        if let Some(step) = run::stopped_at(folder) {
            let steps = config.steps;
            tracing::warn!("{}: incomplete, at step {step} of {steps}", folder.display());
        }
        let gpu = opener.open(&config)?;
        let dataset = Dataset::load(&config.dataset, &config.load_options())?;
        if let Some(difference) = run::other_views(folder, &dataset).filter(|_| is_comparable) {
            let root = dataset.root.display();
            tracing::warn!("{root} differs from the dataset of {}: {difference}", folder.display());
        }
        Ok(Self {
            dataset,
            gaussian_count: model.gaussians.count,
            model_renderer: ModelRenderer::new(
                &gpu,
                &model,
                &config,
                run::load_networks(&gpu, folder, &config.model, model.gaussians.shape.features)?,
            )?,
            states_targets: true,
            config,
            gpu,
        })
    }

    /// [`Self::open_with`] with renders in the light of the photographs, for scores.
    pub(crate) fn open_lit(
        folder: &Path,
        dataset: Option<&Path>,
        opener: &Opener,
        change: impl FnOnce(&mut TrainConfig),
    ) -> Result<Self> {
        let mut run = Self::open_with(folder, dataset, opener, change)?;
        run.model_renderer.light_as(folder, 1.0)?;
        Ok(run)
    }

    /// Opens a model file, which has few settings of its training.
    fn open_model(
        path: &Path,
        dataset: Option<&Path>,
        opener: &Opener,
        change: impl FnOnce(&mut TrainConfig),
    ) -> Result<Self> {
        let (gaussians, facts) = models::read(path)?;
        let dataset = dataset.ok_or_else(|| needs_photographs(path))?;
        let states_targets = facts.targets.is_some();
        let mut config = config_of_file(path, &gaussians, &facts, Some(dataset))?;
        change(&mut config);
        let gpu = (opener.open)(opener.device.as_ref().unwrap_or(&DeviceChoice::Best))?;
        let dataset = Dataset::load(&config.dataset, &config.load_options())?;
        let frame = dataset.frame();
        config.frame = Some(frame);
        // The default is relative to the extent of the scene.
        let near = facts.near.or(config.facts(&frame).near);
        let model = Model::of_shown(gaussians, &ModelFacts { near, ..facts });
        let model_renderer = ModelRenderer::new(&gpu, &model, &config, None)?;
        let gaussian_count = model.gaussians.count;
        Ok(Self { gpu, config, dataset, gaussian_count, model_renderer, states_targets })
    }
}

/// The error for a model file, if a command needs photographs.
pub(crate) fn needs_photographs(path: &Path) -> Error {
    Error::input(path, "is a model file without a run; pass its photographs with --dataset")
}

/// Whether a path names a model file instead of a run.
pub(crate) fn is_model(path: &Path) -> bool {
    let is_named = |name: &OsStr| ["ply", "spz", "sog"].iter().any(|extension| name == *extension);
    path.is_file() || (!path.is_dir() && path.extension().is_some_and(is_named))
}

/// The settings to render and to score a model file with: the defaults, except for those that it states.
///
/// # Errors
/// It states settings that this version does not know.
pub(crate) fn config_of_file(
    path: &Path,
    gaussians: &Gaussians,
    facts: &ModelFacts,
    dataset: Option<&Path>,
) -> Result<TrainConfig> {
    let mut config = TrainConfig {
        dataset: dataset.unwrap_or(Path::new("")).to_owned(),
        sh_degree: gaussians.shape.sh_degree,
        // Of a file that states none, renders are compared with the photographs.
        tone: ToneSettings::new(ToneCurve::None),
        ..TrainConfig::default()
    };
    config.model.raw_colors = facts.raw_colors.unwrap_or(config.model.raw_colors);
    config.antialiasing.compensation = facts.antialiased;
    let Some(stated) = &facts.targets else { return Ok(config) };
    config.with_targets(stated).map_err(|problem| {
        Error::input(path, format!("states targets that this version does not make: {problem}"))
    })
}
