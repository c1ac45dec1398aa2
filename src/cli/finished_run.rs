//! A run, finished or stopped, or a model file, opened to be rendered: what `eval` and `render` begin with.

use std::path::Path;

use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::Dataset;
use crate::photographs::tone::{ToneCurve, ToneSettings};
use crate::results::eval::ModelRenderer;
use crate::results::run;
use crate::splats::scene::{Gaussians, ply};
use crate::train::TrainConfig;
use crate::{Error, Result};

/// The model of a run, with the views it was trained and is scored on.
pub(super) struct FinishedRun {
    pub(super) gpu: Gpu,
    pub(super) config: TrainConfig,
    pub(super) dataset: Dataset,
    pub(super) gaussian_count: usize,
    pub(super) model_renderer: ModelRenderer,
}

impl FinishedRun {
    /// Loads configuration, model and dataset; dataset and device are the run's where nothing else is named. Says where the
    /// run was stopped on its way, and how another dataset differs.
    ///
    /// # Errors
    /// The folder holds no run with a model, its dataset is gone, or there is no such device.
    pub(super) fn open(
        folder: &Path,
        dataset: Option<&Path>,
        device: Option<&DeviceChoice>,
    ) -> Result<Self> {
        Self::open_with(folder, dataset, device, |_| {})
    }

    /// The same with something in the configuration changed.
    ///
    /// # Errors
    /// As there.
    pub(super) fn open_with(
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
                "names the dataset {}, which is not there; name it with --dataset, or correct `dataset` in this file",
                config.dataset.display()
            );
            return Err(Error::input(folder.join("config.toml"), problem));
        }
        if let Some(step) = run::stopped_at(folder) {
            let steps = config.steps;
            tracing::warn!("{}: stopped at step {step} of {steps}", folder.display());
        }
        let device = device.map_or_else(|| config.device.parse(), |choice| Ok(choice.clone()))?;
        let gpu = Gpu::new(&device)?;
        let dataset = Dataset::load(&config.dataset, &config.load_options())?;
        if let Some(difference) = run::other_views(folder, &dataset) {
            let root = dataset.root.display();
            tracing::warn!("{root}: is not what {} was trained on: {difference}", folder.display());
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

    /// The same of a model without a run, which says nothing of how it was trained.
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

/// What to say of a model file where its photographs are needed and not named.
pub(super) fn needs_photographs(path: &Path) -> Error {
    Error::input(path, "is a model without a run; name its photographs with --dataset")
}

/// Whether a path names a model file in place of a run.
pub(super) fn is_model(path: &Path) -> bool {
    path.is_file() || (!path.is_dir() && path.extension().is_some_and(|name| name == "ply"))
}

/// A model file's Gaussians, with the settings that they are shown by, which are the defaults; says that their training is
/// unknown.
///
/// # Errors
/// The file is no model.
pub(super) fn load_model(path: &Path, dataset: Option<&Path>) -> Result<(Gaussians, TrainConfig)> {
    let gaussians = ply::load(path)?;
    let config = TrainConfig {
        dataset: dataset.unwrap_or(Path::new("")).to_owned(),
        sh_degree: gaussians.shape.sh_degree,
        // Without references, photographs are what there is to compare with.
        tone: ToneSettings::new(ToneCurve::None),
        ..TrainConfig::default()
    };
    tracing::warn!(
        "{}: its training is unknown; it is shown with the default near plane",
        path.display()
    );
    Ok((gaussians, config))
}
