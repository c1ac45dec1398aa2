//! The Gaussians that a training starts from: those that it trains, and around a block those that it renders alone.

use std::path::{Path, PathBuf};

use nightsplat_core::camera::Camera;
use nightsplat_models::gaussians::Gaussians;
use nightsplat_models::gaussians::ply::parts::{PART, PartFile};
use nightsplat_models::joined::{MANIFEST, TileManifest};
use nightsplat_photographs::dataset::Dataset;
use nightsplat_photographs::dataset::block::{Block, Cell};
use rayon::prelude::*;

use super::config::TrainConfig;
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
    /// The Gaussians of [`TrainConfig::init`], divided by the halo of the dataset's block if it is one. A model in
    /// tiles is read one tile after the other.
    pub(super) fn load(config: &TrainConfig, dataset: &Dataset) -> Result<Self> {
        let Some(path) = &config.init else { return Ok(Self::default()) };
        let files = files(path)?;
        let block = Block::at(&dataset.root)?.filter(|block| block.halo != Cell::WORLD);
        let cameras: Vec<Camera> = dataset.train_views().map(|view| view.camera).collect();
        let mut initial = Self::default();
        for file in files {
            let mut model = config.initial_model(&file)?;
            if let Some(Block { halo, .. }) = &block {
                Gaussians::add(&mut initial.context, around(&mut model, halo, &cameras));
            }
            Gaussians::add(&mut initial.gaussians, model);
        }
        match (&block, &initial.gaussians) {
            (Some(Block { id, .. }), None) => {
                let problem =
                    format!("has no Gaussian in the halo of block {id}; it is of another scene");
                Err(Error::input(path, problem))
            }
            _ => Ok(initial),
        }
    }

    /// The context alone, for a training whose Gaussians come from a checkpoint. Where there is no block,
    /// [`TrainConfig::init`] is not read.
    pub(super) fn of_restored(config: &TrainConfig, dataset: &Dataset) -> Result<Self> {
        match Block::at(&dataset.root)? {
            None => Ok(Self::default()),
            Some(_) => Ok(Self { gaussians: None, ..Self::load(config, dataset)? }),
        }
    }
}

/// The files of a model: the tiles, if it is in tiles.
fn files(model: &Path) -> Result<Vec<PathBuf>> {
    match model.join(MANIFEST).is_file() {
        true => Ok(TileManifest::load(model)?.files()),
        false => Ok(vec![model.to_owned()]),
    }
}

impl TrainConfig {
    /// The highest SH degree of the files of [`TrainConfig::init`], as far as their headers tell it.
    pub(super) fn initial_degree(&self) -> Option<u32> {
        let files = files(self.init.as_ref()?).ok()?;
        let degree = |file: &PathBuf| Some(PartFile::open(file, PART).ok()??.shape().sh_degree);
        files.iter().filter_map(degree).max()
    }
}

/// Removes the Gaussians outside the halo, and returns those of them that a camera sees.
fn around(gaussians: &mut Gaussians, halo: &Cell, cameras: &[Camera]) -> Gaussians {
    let indices = 0..gaussians.count;
    let is_own: Vec<bool> =
        indices.clone().map(|index| halo.contains(gaussians.position(index))).collect();
    let is_seen = |index: usize| {
        let position = gaussians.position(index);
        let sees = |camera: &Camera| camera.sees_within(position, MARGIN).is_some();
        !is_own[index] && cameras.iter().any(sees)
    };
    let is_context: Vec<bool> = indices.into_par_iter().map(is_seen).collect();
    let mut context = gaussians.clone();
    context.retain(&is_context);
    gaussians.retain(&is_own);
    context
}
