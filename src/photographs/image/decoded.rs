//! The result of decoding an image file.

use super::Image;
use super::colour::Conversion;

/// The meaning of the values of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Meaning {
    /// Colours, which are converted to sRGB.
    Colour,
    /// Other values, such as depth or a mask, which are kept as stored.
    Number,
}

/// The contents of a file.
pub(super) struct DecodedImage {
    pub(super) image: Image,
    pub(super) alpha: Option<Image>,
    pub(super) conversion: Conversion,
}

impl DecodedImage {
    /// Values that are not colours, or are sRGB already.
    pub(super) fn as_stored(image: Image, alpha: Option<Image>) -> Self {
        Self { image, alpha, conversion: Conversion::default() }
    }
}
