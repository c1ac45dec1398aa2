//! How photographs are turned, of which Exif says that they lie on a side.

use crate::camera::Lens;
use crate::photographs::image::Orientation;

/// What the header of a picture says.
#[derive(Clone, Copy, Debug)]
pub(super) struct Header {
    /// Width and height as it is stored.
    pub(super) size: (u32, u32),
    /// How that is turned for people, by its Exif.
    pub(super) orientation: Orientation,
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
    /// Poses are of what is stored, as COLMAP reads it; where the camera's size is that of what is seen, and not of what is
    /// stored, they are of that.
    pub(super) fn new(header: Header, lens: &Lens) -> Self {
        let Header { size, orientation } = header;
        let fits = |(width, height): (u32, u32)| lens.fitted(width, height).is_some();
        if !fits(size) && fits(orientation.size(size)) {
            Self { loading: orientation, viewing: Orientation::UPRIGHT }
        } else {
            Self { loading: Orientation::UPRIGHT, viewing: orientation }
        }
    }
}
