//! A run, finished or stopped, opened to be rendered: what `eval` and `render` begin with.

use std::path::Path;

use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::Dataset;
use crate::results::eval::Player;
use crate::results::run;
use crate::train::TrainConfig;
use crate::{Error, Result};

/// The model of a run, with the views it was trained and is scored on.
pub(super) struct FinishedRun {
    pub(super) gpu: Gpu,
    pub(super) config: TrainConfig,
    pub(super) dataset: Dataset,
    pub(super) gaussian_count: usize,
    pub(super) player: Player,
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
            player: Player::new(
                &gpu,
                &gaussians,
                &config,
                run::load_networks(&gpu, folder, &config.model, gaussians.shape.features)?,
            )?,
            config,
            gpu,
        })
    }
}
