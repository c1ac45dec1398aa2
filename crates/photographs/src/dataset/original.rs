//! Photographs that are decoded again from disk.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use glam::UVec2;
use nightsplat_core::Result;
use nightsplat_core::camera::Lens;
use nightsplat_core::hash::Hasher;

use super::MeasuredSize;
use super::packed::Packed;
use super::prepare::Preparation;
use super::shading::Shading;
use super::turns::Turns;
use crate::image::{ColourCounts, Image, Levels, Orientation, PictureFile};
use crate::tone::MeasuredPhotograph;
use crate::white_balance::WhiteBalanceMatrix;

/// A photograph that was downscaled on loading, or is not kept.
#[derive(Clone, Debug)]
pub struct Original {
    path: PathBuf,
    /// The lens at the photograph's size.
    lens: Lens,
    /// As [`super::LoadOptions::undistort`].
    undistort: bool,
    /// The rotation from the stored pixels to those of the camera.
    orientation: Orientation,
    /// The size that it is decoded at, if that is not its own.
    pub(super) decoded_size: Option<(u32, u32)>,
    /// Levels of a photograph's file.
    pub(super) levels: Levels,
    /// The size that a photograph of linear light is shrunk to before it is tone-mapped.
    pub(super) light_size: Option<(u32, u32)>,
    /// White balance of a photograph.
    pub(super) balance: Option<WhiteBalanceMatrix>,
    /// Shading of a photograph.
    pub(super) shading: Shading,
    /// The statistics of the photograph, and the size they were measured at.
    pub(super) measured: Option<(MeasuredSize, MeasuredPhotograph)>,
    /// The checksum of the pixels as loaded, if they are not kept.
    pub(super) checksum: Option<Hasher>,
    /// The photograph at its original size, if memory allows, until it is released.
    stored: Arc<Mutex<Option<Packed>>>,
}

impl Original {
    pub(super) fn new(path: PathBuf, lens: Lens, undistort: bool, turns: Turns) -> Self {
        Self {
            path,
            lens,
            undistort,
            orientation: turns.loading,
            decoded_size: None,
            levels: Levels::default(),
            light_size: None,
            balance: None,
            shading: Shading::default(),
            measured: None,
            checksum: None,
            stored: Arc::default(),
        }
    }

    /// Width and height at which it is tone-mapped, after undistortion.
    pub(super) fn size(&self) -> UVec2 {
        self.light_size.unwrap_or((self.lens.width, self.lens.height)).into()
    }

    /// Keeps the photograph at its original size in memory.
    pub(super) fn store(&mut self, photograph: Packed) {
        self.stored = Arc::new(Mutex::new(Some(photograph)));
    }

    /// The photograph at its original size, undistorted: from memory, or decoded again.
    pub(super) fn load(&self) -> Result<Image> {
        let stored = self.stored.lock().unwrap_or_else(PoisonError::into_inner);
        match &*stored {
            Some(packed) => Ok(packed.image()),
            None => self.load_at(self.size().into()),
        }
    }

    /// The photograph at another size, undistorted and decoded again.
    pub(super) fn load_at(&self, size: (u32, u32)) -> Result<Image> {
        let Self { path, lens, undistort, .. } = self;
        let preparation = Preparation::new(lens, *undistort, size, &path.to_string_lossy())?;
        let colours = ColourCounts::of_levels(self.levels);
        let file = PictureFile::open(path)?.reduced(|size| self.decoded_size.unwrap_or(size));
        let (mut image, _) = file.decode_counted(&colours)?;
        if let Some(balance) = self.balance {
            balance.apply(&mut image);
        }
        let whole = preparation.photograph(self.orientation.upright(image), path, self.shading)?;
        Ok(match self.light_size {
            Some(_) => preparation.shrunk_in_light(whole),
            None => preparation.shrunk(whole),
        })
    }

    /// The statistics at a size, if they were measured while the photograph was decoded.
    #[doc(hidden)]
    pub fn measured(&self, size: MeasuredSize) -> Option<&MeasuredPhotograph> {
        self.measured
            .as_ref()
            .filter(|(measured_size, _)| *measured_size == size)
            .map(|(_, measured)| measured)
    }

    /// The checksum of the pixels as loaded, if they are not kept.
    pub(super) fn checksum(&self) -> Option<Hasher> {
        self.checksum
    }

    /// Frees the memory of the photograph at its original size.
    #[doc(hidden)]
    pub fn release(&self) {
        *self.stored.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }
}
