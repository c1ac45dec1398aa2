//! The Gaussians that a training starts from: those that it trains, and around a block those that it renders alone.

use rayon::prelude::*;

use super::TrainConfig;
use crate::camera::Camera;
use crate::photographs::dataset::Dataset;
use crate::photographs::dataset::block::{Block, Cell};
use crate::splats::scene::Gaussians;
use crate::{Error, Result};

/// A Gaussian counts as seen up to this far beyond the edges of an image, in widths and heights of the image: it may
/// be large.
const MARGIN: f64 = 0.15;

/// Gaussians in the dataset's world.
#[derive(Debug, Default)]
pub(super) struct Initial {
    /// Those to train; `None`: from the dataset's points, or a checkpoint.
    pub(super) gaussians: Option<Gaussians>,
    /// Those around a block, which its views see. They are rendered, and have neither gradients nor moments.
    pub(super) context: Option<Gaussians>,
}

impl Initial {
    /// The Gaussians of [`TrainConfig::init`], divided by the halo of the dataset's block if it is one.
    ///
    /// # Errors
    /// The file cannot be read or does not fit the model, or none of its Gaussians is in the halo.
    pub(super) fn of(config: &TrainConfig, dataset: &Dataset) -> Result<Self> {
        let Some(gaussians) = config.initial_model()? else { return Ok(Self::default()) };
        let block = Block::at(&dataset.root)?.filter(|block| block.halo != Cell::WORLD);
        let Some(Block { id, halo, .. }) = block else {
            return Ok(Self { gaussians: Some(gaussians), context: None });
        };
        let positions = (0..gaussians.count).map(|index| gaussians.position(index));
        let is_own: Vec<bool> = positions.map(|position| halo.contains(position)).collect();
        if !is_own.contains(&true) {
            let problem =
                format!("has no Gaussian in the halo of block {id}; it is of another scene");
            let path = config.init.clone().unwrap_or_default();
            return Err(Error::input(path, problem));
        }
        let cameras: Vec<Camera> = dataset.train_views().map(|view| view.camera).collect();
        let is_seen = |index: usize| {
            let position = gaussians.position(index);
            !is_own[index]
                && cameras.iter().any(|camera| camera.sees_within(position, MARGIN).is_some())
        };
        let is_context: Vec<bool> = (0..gaussians.count).into_par_iter().map(is_seen).collect();
        let mut context = gaussians.clone();
        context.retain(&is_context);
        let mut own = gaussians;
        own.retain(&is_own);
        tracing::info!("{} Gaussians around the block are rendered and not trained", context.count);
        Ok(Self {
            gaussians: Some(own),
            context: Some(context).filter(|context| context.count > 0),
        })
    }

    /// The context alone, for a training whose Gaussians come from a checkpoint. Where there is no block,
    /// [`TrainConfig::init`] is not read.
    ///
    /// # Errors
    /// Those of [`Self::of`].
    pub(super) fn of_restored(config: &TrainConfig, dataset: &Dataset) -> Result<Self> {
        match Block::at(&dataset.root)? {
            None => Ok(Self::default()),
            Some(_) => Ok(Self { gaussians: None, ..Self::of(config, dataset)? }),
        }
    }
}
