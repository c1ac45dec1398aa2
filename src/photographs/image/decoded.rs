//! What a file of pixels is decoded to.

use super::Image;
use super::colour::Conversion;

/// What the numbers of a file are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Meaning {
    /// Colours, which become sRGB.
    Colour,
    /// Something else, such as a depth or a mask, which is taken as it is stored.
    Number,
}

/// What a file holds.
pub(super) struct Decoded {
    pub(super) image: Image,
    pub(super) alpha: Option<Image>,
    pub(super) conversion: Conversion,
}

impl Decoded {
    /// Values that are no colours, or sRGB already.
    pub(super) fn as_stored(image: Image, alpha: Option<Image>) -> Self {
        Self { image, alpha, conversion: Conversion::default() }
    }
}
