//! Options of loading a dataset.

use std::ops::Bound;
use std::path::PathBuf;

use nightsplat_core::settings::Rule;
use nightsplat_core::{Error, Result};

use super::PixelOrientation;
use super::normals::NormalAxes;
use super::shading::RowBands;
use crate::image::{StoredLight, reduced_size};
use crate::tree;
use crate::white_balance::WhiteBalance;

/// The range of the downscaling factor.
pub const DOWNSCALE: Rule = Rule::Number(Bound::Included(1.0), Bound::Unbounded);

/// Options of loading a dataset.
#[derive(Clone, Debug)]
pub struct LoadOptions {
    /// Factor on width and height, at least 1; sizes are rounded to whole pixels.
    pub downscale: f64,
    /// Maximum longest side of a view, pixels: photographs that are larger after `downscale` are reduced to it; 0: no
    /// limit.
    pub max_resolution: u32,
    /// Every Nth view by name is held out, instead of the dataset's split; 0: none. `None`: the dataset's own split,
    /// else every eighth, and none of fewer than eight photographs.
    pub test_every: Option<usize>,
    /// Patterns of the names of photographs that are left out; the others keep their split.
    pub exclude: Vec<String>,
    /// Bytes that the decoded training photographs may take: if they exceed this, none is kept, and each is decoded
    /// again on every use. `None`: no limit.
    pub keep: Option<u64>,
    /// The folder with the photographs under their listed names, instead of their listed paths.
    pub images: Option<PathBuf>,
    /// Which pixels the cameras are of, where a photograph's Exif turns or mirrors it and sizes do not tell.
    pub orientation: PixelOrientation,
    /// A folder of reference images by name, in place of what is found beside the input.
    pub reference: Option<PathBuf>,
    /// A folder of targets by name, which another program made of the photographs.
    pub targets: Option<PathBuf>,
    /// Whether test views also load their dark photograph, if any.
    pub load_low_test: bool,
    /// Number of training views, at most an eighth, that are held out to detect convergence.
    pub hold_out: usize,
    /// Masks hide white instead of black.
    pub invert_masks: bool,
    /// Mask black borders that photographs have in the same place, as undistorting leaves them.
    pub mask_borders: bool,
    /// How integer files of the photographs store light; `None`: as sRGB, with the levels that their values show.
    pub light: Option<StoredLight>,
    /// Mask what hardly changes between views that move, such as a date burnt into every photograph.
    pub mask_overlays: bool,
    /// Gains of the channels of the photographs; reference images are unchanged.
    pub white_balance: Option<WhiteBalance>,
    /// The fall-off of the lens: the light of the photographs is multiplied by exp(a u + b u^2), with u = 1 - cos of
    /// the angle off the axis.
    pub falloff: Option<[f64; 2]>,
    /// Bands of rows of the photographs, which are evened out.
    pub bands: Option<RowBands>,
    /// The size at which training photographs are measured while they are decoded, if they are not kept at that size.
    pub measured: MeasuredSize,
    /// Undistort photographs of a fisheye to a pinhole's, as for every other lens, instead of training with the fisheye
    /// model.
    pub undistort: bool,
    /// Depth maps of the training views.
    pub depth: DepthOptions,
    /// Normal maps of the training views.
    pub normals: NormalOptions,
}

/// The size at which a curve is applied to photographs, and at which these are measured for it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MeasuredSize {
    /// No measurement.
    #[default]
    None,
    /// The original size.
    Own,
    /// The size of the view's camera.
    Loaded,
}

/// The location of depth maps: `STEM.*` or `depth_STEM.*` in a folder.
#[derive(Clone, Debug, Default)]
pub struct DepthOptions {
    /// Whether depth maps are loaded.
    pub load: bool,
    /// The folder; `None`: `depth/` or `depth_maps/` of the dataset.
    pub folder: Option<PathBuf>,
    /// The maps are disparity, in which larger is nearer; they are negated.
    pub is_disparity: bool,
}

/// The location of normal maps: `STEM.*` or `normal_STEM.*` in a folder.
#[derive(Clone, Debug, Default)]
pub struct NormalOptions {
    /// Whether normal maps are loaded.
    pub load: bool,
    /// The folder; `None`: `normals/` or `normal_maps/` of the dataset.
    pub folder: Option<PathBuf>,
    /// The axes of their vectors.
    pub axes: NormalAxes,
}

impl Default for LoadOptions {
    fn default() -> Self {
        Self {
            downscale: 1.0,
            max_resolution: 0,
            test_every: None,
            exclude: vec![],
            keep: None,
            images: None,
            orientation: PixelOrientation::Auto,
            reference: None,
            targets: None,
            load_low_test: true,
            hold_out: 0,
            invert_masks: false,
            mask_borders: true,
            light: None,
            mask_overlays: true,
            white_balance: None,
            falloff: None,
            bands: None,
            measured: MeasuredSize::default(),
            undistort: false,
            depth: DepthOptions::default(),
            normals: NormalOptions::default(),
        }
    }
}

impl LoadOptions {
    /// The size at which a photograph of this size is loaded.
    #[doc(hidden)]
    pub fn loaded_size(&self, width: u32, height: u32) -> (u32, u32) {
        let beyond = self.beyond(width, height);
        let side = |pixels: u32| (f64::from(pixels) / self.downscale / beyond).round() as u32;
        (side(width), side(height))
    }

    /// The size at which a photograph of this size is decoded: a large one is reduced, unless it is loaded larger.
    #[doc(hidden)]
    pub fn decoded_size(&self, (width, height): (u32, u32)) -> (u32, u32) {
        reduced_size((width, height), self.loaded_size(width, height))
    }

    /// The downscaling factor of a photograph of this size.
    #[doc(hidden)]
    pub fn shrink(&self, width: u32, height: u32) -> f64 {
        self.downscale * self.beyond(width, height)
    }

    /// The factor by which the longest side exceeds `max_resolution` after `downscale`.
    fn beyond(&self, width: u32, height: u32) -> f64 {
        let longest = f64::from(width.max(height)) / self.downscale;
        let limit = f64::from(self.max_resolution);
        if self.max_resolution > 0 { (longest / limit).max(1.0) } else { 1.0 }
    }

    /// Refuses invalid options.
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
            (&self.targets, "targets"),
            (&self.depth.folder, "depth maps"),
            (&self.normals.folder, "normal maps"),
        ];
        for (folder, of) in folders {
            if let Some(folder) = folder.as_ref().filter(|folder| !tree::is_dir(folder)) {
                return Err(Error::input(folder, format!("is not a folder of {of}")));
            }
        }
        Ok(())
    }
}
