//! Which pixels the cameras are of, where Exif turns or mirrors a photograph: those that are stored, as COLMAP reads
//! them, or those that Exif shows, as many converters write them.

use std::str::FromStr;

use nightsplat_core::camera::Lens;
use nightsplat_core::{Error, Result};
use serde::{Deserialize, Serialize};

use crate::image::Orientation;

/// Which pixels the cameras of a dataset are of, where a photograph's Exif turns or mirrors it and its size does not
/// decide it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PixelOrientation {
    /// As for the photographs whose sizes decide it; else as the points that photographs share decide it; else those
    /// that are stored, with a warning.
    #[default]
    Auto,
    /// Those that are stored.
    Stored,
    /// Those that Exif shows.
    Exif,
}

impl PixelOrientation {
    /// Their names.
    #[doc(hidden)]
    pub const NAMES: [&'static str; 3] = ["auto", "stored", "exif"];
}

impl FromStr for PixelOrientation {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match name {
            "auto" => Ok(Self::Auto),
            "stored" => Ok(Self::Stored),
            "exif" => Ok(Self::Exif),
            _ => Err(Error::Usage(format!("unknown orientation `{name}`; auto, stored or exif"))),
        }
    }
}

/// The pixels that the cameras of a dataset are of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CameraPixels {
    Stored,
    Exif,
}

/// What the header of a picture says.
#[derive(Clone, Copy, Debug)]
pub(super) struct ImageHeader {
    /// Width and height as it is stored.
    pub(super) size: (u32, u32),
    /// Width and height as it is decoded.
    pub(super) decoded_size: (u32, u32),
    /// How that is turned for people, by its Exif.
    pub(super) orientation: Orientation,
}

impl ImageHeader {
    /// The pixels that a camera is of, by its size; `None` if both have this size.
    pub(super) fn by_size(self, lens: &Lens) -> Option<CameraPixels> {
        let fits = |(width, height): (u32, u32)| lens.fitted(width, height).is_some();
        match (fits(self.size), fits(self.orientation.size(self.size))) {
            (true, true) => None,
            (false, true) => Some(CameraPixels::Exif),
            (_, false) => Some(CameraPixels::Stored),
        }
    }
}

/// How a photograph is turned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Turns {
    /// On loading: from what is stored to what the camera took.
    pub(super) loading: Orientation,
    /// For people: from what the camera took to what is seen.
    pub(super) viewing: Orientation,
}

impl Turns {
    /// Of a picture whose camera is of these pixels unless their sizes say otherwise.
    pub(super) fn new(header: ImageHeader, lens: &Lens, pixels: CameraPixels) -> Self {
        let orientation = header.orientation;
        match header.by_size(lens).unwrap_or(pixels) {
            CameraPixels::Exif => Self { loading: orientation, viewing: Orientation::UPRIGHT },
            CameraPixels::Stored => Self { loading: Orientation::UPRIGHT, viewing: orientation },
        }
    }
}
