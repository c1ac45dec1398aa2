//! How a dataset is loaded.

use std::path::PathBuf;

use crate::{Error, Result};

/// How a dataset is loaded.
#[derive(Clone, Debug)]
pub struct LoadOptions {
    /// Factor by which width and height shrink, at least 1; sizes are rounded to whole pixels.
    pub downscale: f64,
    /// A folder of reference images by name, in place of what is found beside the input.
    pub reference: Option<PathBuf>,
    /// Whether test views load their dark photograph too, where there is one.
    pub load_low_test: bool,
    /// How many training views are kept from training, an eighth of them at most, to tell when it has converged.
    pub hold_out: usize,
    /// Masks hide what is white, not what is black.
    pub invert_masks: bool,
    /// What is looked for as the training views' depth.
    pub depth: DepthOptions,
}

/// Where depth maps come from: `STEM.*` or `depth_STEM.*` in a folder.
#[derive(Clone, Debug, Default)]
pub struct DepthOptions {
    /// Whether depth is loaded at all.
    pub load: bool,
    /// The folder; none: `depth/` or `depth_maps/` of the dataset.
    pub folder: Option<PathBuf>,
    /// The maps hold disparity, larger is nearer: they are negated.
    pub is_disparity: bool,
}

impl Default for LoadOptions {
    fn default() -> Self {
        Self {
            downscale: 1.0,
            reference: None,
            load_low_test: true,
            hold_out: 0,
            invert_masks: false,
            depth: DepthOptions::default(),
        }
    }
}

impl LoadOptions {
    /// Refuses options that make no sense.
    ///
    /// # Errors
    /// [`Error::Usage`] for the downscale, [`Error::Input`] for a folder that is not there.
    pub(super) fn check(&self) -> Result<()> {
        // Positive phrasing: a NaN fails the test too.
        if !(self.downscale >= 1.0 && self.downscale.is_finite()) {
            let downscale = self.downscale;
            return Err(Error::Usage(format!(
                "`LoadOptions::downscale` is {downscale}; it must be 1 or more"
            )));
        }
        match &self.reference {
            Some(folder) if !folder.is_dir() => {
                Err(Error::input(folder, "is not a folder of reference images"))
            }
            _ => Ok(()),
        }?;
        match &self.depth.folder {
            Some(folder) if !folder.is_dir() => {
                Err(Error::input(folder, "is not a folder of depth maps"))
            }
            _ => Ok(()),
        }
    }
}
