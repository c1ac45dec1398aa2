//! The result of decoding an image file.

use super::Image;
use super::colour::Conversion;
use super::levels::SampleFormat;

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
    /// `None` for camera RAW.
    pub(super) format: Option<SampleFormat>,
    /// A value is beyond the levels of the set.
    pub(super) is_beyond: bool,
    /// What is unusual about the values, without the file's name.
    pub(super) remark: Option<String>,
}

impl DecodedImage {
    /// Values that are not colours, or are sRGB already.
    pub(super) fn as_stored(image: Image, alpha: Option<Image>) -> Self {
        Self {
            image,
            alpha,
            conversion: Conversion::default(),
            format: None,
            is_beyond: false,
            remark: None,
        }
    }
}
