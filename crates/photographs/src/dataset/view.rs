//! A view of a dataset: its photograph, camera and use.

use std::borrow::Cow;

use glam::UVec2;
use nightsplat_core::Result;
use nightsplat_core::camera::Camera;

use super::{NormalMap, Original};
use crate::image::{Image, Mask, Orientation};
use crate::tone::MeasuredPhotograph;

/// A photograph's place in the dataset.
#[derive(Clone, Debug)]
pub struct View {
    /// The photograph's file name without extension, prefixed with its folder if several folders contain such a file
    /// (`a_001`); unique.
    pub name: String,
    /// Whether it is trained on or scored.
    pub split: Split,
    /// Undistorted, at the loaded resolution. If the photograph's Exif rotates it, the camera is that of the pixels as
    /// stored, unless the dataset's sizes indicate otherwise.
    pub camera: Camera,
    /// The rotation of its images for display.
    pub orientation: Orientation,
    /// The photograph to train on. For every training view it is in memory, or is decoded again on every use
    /// ([`View::loaded`]).
    pub image: Option<Image>,
    /// Its file, if the stored size is larger or the photograph is not kept.
    pub original: Option<Original>,
    /// The unit of linear light of the photograph's file, for files of floats that are not relative to white; else 1.
    pub unit: f32,
    /// The normal-light photograph to score against, of the camera's size; only for test views. Like the photograph, it
    /// is in memory or decoded again ([`View::loaded_reference`]).
    pub reference: Option<Image>,
    /// Its file, if it is not kept.
    pub reference_file: Option<Original>,
    /// The file of its target that another program made of the photograph.
    pub target_file: Option<Original>,
    /// The usable pixels, of the camera's size; `None` if all are usable.
    pub mask: Option<Mask>,
    /// An external depth map, (H, W) of the camera's size, in arbitrary units and with an arbitrary offset; larger is
    /// farther. Only for training views, and `None` if it is constant.
    pub depth: Option<Vec<f32>>,
    /// External normals, of the camera's size. Only for training views of a pinhole, and `None` if no pixel has one.
    pub normals: Option<NormalMap>,
}

impl View {
    /// A view with a camera and, optionally, a photograph.
    pub fn new(name: &str, split: Split, camera: Camera, image: Option<Image>) -> Self {
        Self {
            name: name.to_owned(),
            split,
            camera,
            orientation: Orientation::UPRIGHT,
            image,
            original: None,
            unit: 1.0,
            reference: None,
            reference_file: None,
            target_file: None,
            mask: None,
            depth: None,
            normals: None,
        }
    }

    /// The camera for upright images, rotated about its optical axis; mirrored images stay as stored.
    pub fn upright_camera(&self) -> Camera {
        self.camera.turned(self.orientation.quarters())
    }

    /// An image of its camera, upright.
    #[doc(hidden)]
    pub fn upright(&self, image: Image) -> Image {
        self.orientation.upright(image)
    }

    /// Whether the view is trained on.
    pub fn is_train(&self) -> bool {
        self.split == Split::Train
    }

    /// Whether the view is for training, including those held out to detect convergence.
    #[doc(hidden)]
    pub fn is_for_training(&self) -> bool {
        self.split != Split::Test
    }

    /// The planes of one of its images, of any size, without masked pixels.
    #[doc(hidden)]
    pub fn counted<'a>(&self, image: &'a Image) -> Cow<'a, [f32]> {
        match &self.mask {
            Some(mask) => mask.counted(image).into(),
            None => (&image.data).into(),
        }
    }

    /// The measurements of one of its images, of any size, without masked pixels.
    #[doc(hidden)]
    pub fn measured(&self, image: &Image) -> MeasuredPhotograph {
        MeasuredPhotograph::measure(&self.counted(image)).seen_by(&self.camera)
    }

    /// One of its images, of any size, with masked pixels black.
    #[doc(hidden)]
    pub fn blacked_out(&self, image: Image) -> Image {
        match &self.mask {
            Some(mask) => mask.blacked_out(image),
            None => image,
        }
    }

    /// Whether there is a photograph, kept or to be decoded again.
    #[doc(hidden)]
    pub fn has_photograph(&self) -> bool {
        self.image.is_some() || self.original.is_some()
    }

    /// Whether there is a reference image, kept or to be decoded again.
    #[doc(hidden)]
    pub fn has_reference(&self) -> bool {
        self.reference.is_some() || self.reference_file.is_some()
    }

    /// The photograph at the size of the view's camera; `None` if the view has none.
    ///
    /// # Errors
    /// [`Error::Input`](nightsplat_core::Error::Input) if it was not kept and its file can no longer be read.
    pub fn loaded(&self) -> Result<Option<Cow<'_, Image>>> {
        self.kept_or_read(self.image.as_ref(), self.original.as_ref())
    }

    /// The reference image, of the same size; `None` if the view has none.
    ///
    /// # Errors
    /// As [`View::loaded`].
    pub fn loaded_reference(&self) -> Result<Option<Cow<'_, Image>>> {
        self.kept_or_read(self.reference.as_ref(), self.reference_file.as_ref())
    }

    /// The target that another program made, of the photograph's size, undistorted as that is; `None` if there is none.
    ///
    /// # Errors
    /// [`Error::Input`](nightsplat_core::Error::Input) if its file cannot be read.
    #[doc(hidden)]
    pub fn external_target(&self) -> Result<Option<Image>> {
        self.target_file.as_ref().map(Original::load).transpose()
    }

    fn kept_or_read<'a>(
        &self,
        kept: Option<&'a Image>,
        file: Option<&Original>,
    ) -> Result<Option<Cow<'a, Image>>> {
        let size = (self.camera.width, self.camera.height);
        match (kept, file) {
            (Some(image), _) => Ok(Some(Cow::Borrowed(image))),
            (None, Some(file)) => file.load_at(size).map(Cow::Owned).map(Some),
            (None, None) => Ok(None),
        }
    }

    /// Width and height of [`View::photograph`]; `None` if the view has none.
    #[doc(hidden)]
    pub fn own_size(&self) -> Option<UVec2> {
        let kept = self.image.as_ref().map(|image| UVec2::new(image.width, image.height));
        self.original.as_ref().map(Original::size).or(kept)
    }

    /// The undistorted photograph at its original size; `None` if the view has none.
    ///
    /// # Errors
    /// [`Error::Input`](nightsplat_core::Error::Input) if it was downscaled on loading and its file cannot be read any
    /// more.
    pub fn photograph(&self) -> Result<Option<Cow<'_, Image>>> {
        match &self.original {
            Some(original) => original.load().map(Cow::Owned).map(Some),
            None => Ok(self.image.as_ref().map(Cow::Borrowed)),
        }
    }
}

/// The use of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// Trained on.
    Train,
    /// Held out, for scores.
    Test,
    /// A training photograph that is held out to detect convergence.
    HeldOut,
}
