//! How a dataset is loaded.

use std::ops::Bound;
use std::path::PathBuf;

use super::PixelOrientation;
use crate::base::settings::Rule;
use crate::base::tree;
use crate::photographs::white_balance::WhiteBalance;
use crate::{Error, Result};

/// The factors by which photographs may shrink.
pub const DOWNSCALE: Rule = Rule::Number(Bound::Included(1.0), Bound::Unbounded);

/// How a dataset is loaded.
#[derive(Clone, Debug)]
pub struct LoadOptions {
    /// Factor by which width and height shrink, at least 1; sizes are rounded to whole pixels.
    pub downscale: f64,
    /// The longest side of a view, pixels: photographs that exceed it behind `downscale` shrink to it; 0: they do not.
    pub max_resolution: u32,
    /// Every so many views by name are held out, whatever split the dataset has; 0: none; left out: the dataset's own
    /// split, else every eighth.
    pub test_every: Option<usize>,
    /// Bytes that the decoded photographs to train on may take: where they take more, none is kept, and each is read anew
    /// whenever it is looked at; none: no limit.
    pub keep: Option<u64>,
    /// The folder that holds the photographs by their listed names, in place of where the listing says they are.
    pub images: Option<PathBuf>,
    /// Which pixels the cameras are of, where a photograph's Exif turns or mirrors it and sizes do not tell.
    pub orientation: PixelOrientation,
    /// A folder of reference images by name, in place of what is found beside the input.
    pub reference: Option<PathBuf>,
    /// Whether test views load their dark photograph too, where there is one.
    pub load_low_test: bool,
    /// How many training views are kept from training, an eighth of them at most, to tell when it has converged.
    pub hold_out: usize,
    /// Masks hide what is white, not what is black.
    pub invert_masks: bool,
    /// Black borders that photographs have in the same place, as undistorting leaves them, are masked.
    pub mask_borders: bool,
    /// Gains of the channels of the photographs; reference images stay as they are.
    pub white_balance: Option<WhiteBalance>,
    /// At which size training photographs are measured while they are decoded, if they are not kept at that size.
    pub measured: MeasuredSize,
    /// Photographs of a fisheye are undistorted to a pinhole's, too, as those of every other lens are; without it the
    /// fisheye itself is trained on.
    pub undistort: bool,
    /// What is looked for as the training views' depth.
    pub depth: DepthOptions,
}

/// At which size a curve is applied to photographs, and what it follows from is measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MeasuredSize {
    /// They are not measured.
    #[default]
    None,
    /// Their own.
    Own,
    /// That of the view's camera.
    Loaded,
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
            max_resolution: 0,
            test_every: None,
            keep: None,
            images: None,
            orientation: PixelOrientation::Auto,
            reference: None,
            load_low_test: true,
            hold_out: 0,
            invert_masks: false,
            mask_borders: true,
            white_balance: None,
            measured: MeasuredSize::default(),
            undistort: false,
            depth: DepthOptions::default(),
        }
    }
}

impl LoadOptions {
    /// The size at which a photograph of this size is loaded.
    pub(crate) fn loaded_size(&self, width: u32, height: u32) -> (u32, u32) {
        let beyond = self.beyond(width, height);
        let side = |pixels: u32| (f64::from(pixels) / self.downscale / beyond).round() as u32;
        (side(width), side(height))
    }

    /// Pixels of a photograph of this size to a pixel of it as loaded, each way.
    pub(crate) fn shrink(&self, width: u32, height: u32) -> f64 {
        self.downscale * self.beyond(width, height)
    }

    /// How many times the longest side exceeds `max_resolution` behind `downscale`.
    fn beyond(&self, width: u32, height: u32) -> f64 {
        let longest = f64::from(width.max(height)) / self.downscale;
        let limit = f64::from(self.max_resolution);
        if self.max_resolution > 0 { (longest / limit).max(1.0) } else { 1.0 }
    }

    /// Refuses options that make no sense.
    ///
    /// # Errors
    /// [`Error::Setting`], and [`Error::Input`] for a folder that is not there.
    pub(super) fn check(&self) -> Result<()> {
        let refused = |key: &str, value: f64, rule: &dyn ToString| {
            let (key, value, rule) = (key.to_owned(), value.to_string(), rule.to_string());
            Err(Error::Setting { key, value, rule })
        };
        if !DOWNSCALE.takes_number(self.downscale) {
            return refused("downscale", self.downscale, &DOWNSCALE);
        }
        if self.test_every == Some(1) {
            return refused(
                "test_every",
                1.0,
                &"0, or 2 and more: else no view is left to train on",
            );
        }
        let folders = [
            (&self.images, "photographs"),
            (&self.reference, "reference images"),
            (&self.depth.folder, "depth maps"),
        ];
        for (folder, of) in folders {
            if let Some(folder) = folder.as_ref().filter(|folder| !tree::is_dir(folder)) {
                return Err(Error::input(folder, format!("is not a folder of {of}")));
            }
        }
        Ok(())
    }
}
