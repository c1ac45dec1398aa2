//! A finished run, opened to be rendered: what `eval` and `render` begin with.

use std::path::Path;

use crate::dataset::Dataset;
use crate::eval::Player;
use crate::gpu::{DeviceChoice, Gpu};
use crate::run;
use crate::train::TrainConfig;
use crate::{Error, Result};

/// The model of a run, with the views it was trained and is scored on.
pub(super) struct FinishedRun {
    pub(super) config: TrainConfig,
    pub(super) dataset: Dataset,
    pub(super) gaussian_count: usize,
    pub(super) player: Player,
}

impl FinishedRun {
    /// Loads configuration, model and dataset; the device is the run's where `device` names no other.
    ///
    /// # Errors
    /// The folder holds no finished run, its dataset is gone, or there is no such device.
    pub(super) fn open(folder: &Path, device: Option<&DeviceChoice>) -> Result<Self> {
        let config = run::load_config(folder)?;
        let raw_colors = config.model.raw_colors;
        let gaussians = run::load_model(folder, raw_colors)?;
        if !config.dataset.is_dir() {
            let problem = format!(
                "names the dataset {}, which is not there; correct `dataset` in this file",
                config.dataset.display()
            );
            return Err(Error::input(folder.join("config.toml"), problem));
        }
        let device = device.map_or_else(|| config.device.parse(), |choice| Ok(choice.clone()))?;
        let gpu = Gpu::new(&device)?;
        Ok(Self {
            dataset: Dataset::load(&config.dataset, &config.load_options())?,
            gaussian_count: gaussians.count,
            player: Player::new(
                &gpu,
                &gaussians,
                &config,
                run::load_networks(&gpu, folder, &config.model, gaussians.shape.features)?,
            )?,
            config,
        })
    }
}
