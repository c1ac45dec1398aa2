//! The files of a view.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DAffine3;
use nightsplat_core::camera::Lens;

use super::allowance::Allowance;
use super::turns::{ImageHeader, Turns};
use super::{LoadOptions, Split};
use crate::image::ImageFile as _;
use crate::image::{Image, MaskFile, Orientation, PictureFile};
use crate::tree;

/// The files and the camera of a view.
#[derive(Clone, Debug)]
pub(super) struct ViewFiles {
    pub(super) name: String,
    pub(super) split: Split,
    /// As listed; `fit` scales it to the photograph's size.
    pub(super) lens: Lens,
    pub(super) view_from_world: DAffine3,
    pub(super) input: Option<PathBuf>,
    pub(super) reference: Option<PathBuf>,
    pub(super) target: Option<PathBuf>,
    pub(super) mask: Option<MaskFile>,
    pub(super) depth: Option<PathBuf>,
    pub(super) normals: Option<PathBuf>,
    /// Photograph and reference image, if they are already read.
    pub(super) read: [Option<Arc<PictureFile>>; 2],
    /// The sizes that these are decoded at, once their headers are read.
    pub(super) decoded_sizes: [Option<(u32, u32)>; 2],
    /// The size of the photograph as its camera took it. It is that of the lens unless the photograph is reduced while
    /// it is decoded.
    pub(super) size: (u32, u32),
    /// How photograph and reference image are turned.
    pub(super) turns: [Turns; 2],
}

impl ViewFiles {
    /// Reads the files of the photograph and of the reference image; returns the header of each, if readable, and keeps
    /// the files while `memory` allows.
    pub(super) fn headers(
        &mut self,
        memory: &Allowance,
        options: &LoadOptions,
    ) -> [Option<ImageHeader>; 2] {
        let paths = [self.input.as_deref(), self.reference.as_deref()];
        let mut headers = [None; 2];
        let of_size = |size, orientation| {
            let decoded_size = options.decoded_size(size);
            ImageHeader { size, decoded_size, orientation }
        };
        for ((path, read), header) in paths.into_iter().zip(&mut self.read).zip(&mut headers) {
            let Some(path) = path else { continue };
            let bytes = tree::metadata(path).map_or(u64::MAX, |(length, _)| length);
            if !memory.take(bytes) {
                let orientation = || Orientation::from_file(path);
                *header = Image::size_of(path).ok().map(|size| of_size(size, orientation()));
            } else if let Ok(file) = PictureFile::open(path) {
                *header = file.size().ok().map(|size| of_size(size, file.orientation()));
                *read = Some(Arc::new(file.reduced(|size| options.decoded_size(size))));
            }
        }
        self.decoded_sizes = headers.map(|header| header.map(|header| header.decoded_size));
        headers
    }

    /// The path of the photograph, and its file if that is already read.
    pub(super) fn photograph(&self) -> Option<(&Path, Option<&PictureFile>)> {
        Some((self.input.as_deref()?, self.read[0].as_deref()))
    }

    /// The photograph as it is stored, white where its alpha hides it; `None` where there is none that decodes.
    pub(super) fn picture(&self) -> Option<Image> {
        let file = match &self.read[0] {
            Some(read) => PictureFile::clone(read),
            None => {
                let at = self.decoded_sizes[0];
                PictureFile::open(self.input.as_deref()?).ok()?.reduced(|size| at.unwrap_or(size))
            }
        };
        shown(file)
    }
}

/// A picture, white where its alpha hides it; `None` where it does not decode.
pub(super) fn shown(file: PictureFile) -> Option<Image> {
    let (mut image, alpha) = file.decode().ok()?;
    if let Some(alpha) = alpha {
        for (value, alpha) in image.data.iter_mut().zip(alpha.data) {
            *value = if alpha < 1.0 { 1.0 } else { *value };
        }
    }
    Some(image)
}

/// Maximum size of files that are read before they are decoded, bytes: others are opened once for their size, and
/// again.
pub(super) const MAX_READ: u64 = 1 << 28;
