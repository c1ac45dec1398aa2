//! A run, finished or interrupted, or a model file, opened for rendering by `eval`, `render` and others.

use std::path::Path;

use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::Dataset;
use crate::photographs::tone::{ToneCurve, ToneSettings};
use crate::results::eval::ModelRenderer;
use crate::results::run;
use crate::splats::scene::{Gaussians, ply};
use crate::train::TrainConfig;
use crate::{Error, Result};

/// The model of a run with its dataset.
pub(crate) struct FinishedRun {
    pub(crate) gpu: Gpu,
    pub(crate) config: TrainConfig,
    pub(crate) dataset: Dataset,
    pub(crate) gaussian_count: usize,
    pub(crate) model_renderer: ModelRenderer,
}

impl FinishedRun {
    /// Loads configuration, model and dataset; dataset and device default to the run's. Warns if the run is incomplete
    /// or the dataset has changed.
    ///
    /// # Errors
    /// The folder contains no run with a model, its dataset is missing, or there is no such device.
    pub(crate) fn open(
        folder: &Path,
        dataset: Option<&Path>,
        device: Option<&DeviceChoice>,
    ) -> Result<Self> {
        Self::open_with(folder, dataset, device, |_| {})
    }

    /// [`Self::open`] with a change of the configuration.
    ///
    /// # Errors
    /// Those of [`Self::open`].
    pub(crate) fn open_with(
        folder: &Path,
        dataset: Option<&Path>,
        device: Option<&DeviceChoice>,
        change: impl FnOnce(&mut TrainConfig),
    ) -> Result<Self> {
        if is_model(folder) {
            return Self::open_model(folder, dataset, device);
        }
        let mut config = run::load_config(folder)?;
        if let Some(dataset) = dataset {
            config.move_dataset(dataset);
        }
        change(&mut config);
        let raw_colors = config.model.raw_colors;
        let gaussians = run::load_model(folder, raw_colors)?;
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
        let device = device.map_or_else(|| config.device.parse(), |choice| Ok(choice.clone()))?;
        let gpu = Gpu::new(&device)?;
        let dataset = Dataset::load(&config.dataset, &config.load_options())?;
        if let Some(difference) = run::other_views(folder, &dataset) {
            let root = dataset.root.display();
            tracing::warn!("{root} differs from the dataset of {}: {difference}", folder.display());
        }
        Ok(Self {
            dataset,
            gaussian_count: gaussians.count,
            model_renderer: ModelRenderer::new(
                &gpu,
                &gaussians,
                &config,
                run::load_networks(&gpu, folder, &config.model, gaussians.shape.features)?,
            )?,
            config,
            gpu,
        })
    }

    /// Opens a model file, which has no settings of its training.
    fn open_model(
        path: &Path,
        dataset: Option<&Path>,
        device: Option<&DeviceChoice>,
    ) -> Result<Self> {
        let dataset = dataset.ok_or_else(|| needs_photographs(path))?;
        let (gaussians, mut config) = load_model(path, Some(dataset))?;
        let gpu = Gpu::new(device.unwrap_or(&DeviceChoice::Best))?;
        let dataset = Dataset::load(&config.dataset, &config.load_options())?;
        config.frame = Some(dataset.frame());
        let model_renderer = ModelRenderer::new(&gpu, &gaussians, &config, None)?;
        Ok(Self { gpu, config, dataset, gaussian_count: gaussians.count, model_renderer })
    }
}

/// The error for a model file, if a command needs photographs.
pub(crate) fn needs_photographs(path: &Path) -> Error {
    Error::input(path, "is a model file without a run; pass its photographs with --dataset")
}

/// Whether a path names a model file instead of a run.
pub(crate) fn is_model(path: &Path) -> bool {
    path.is_file() || (!path.is_dir() && path.extension().is_some_and(|name| name == "ply"))
}

/// Loads the Gaussians of a model file with default rendering settings, and warns about that.
///
/// # Errors
/// The file is not a model.
pub(crate) fn load_model(path: &Path, dataset: Option<&Path>) -> Result<(Gaussians, TrainConfig)> {
    let gaussians = ply::load(path)?;
    let config = TrainConfig {
        dataset: dataset.unwrap_or(Path::new("")).to_owned(),
        sh_degree: gaussians.shape.sh_degree,
        // Without reference images, renders are compared with the photographs.
        tone: ToneSettings::new(ToneCurve::None),
        ..TrainConfig::default()
    };
    tracing::warn!(
        "{}: the settings of its training are unknown; rendering with the default near plane",
        path.display()
    );
    Ok((gaussians, config))
}
