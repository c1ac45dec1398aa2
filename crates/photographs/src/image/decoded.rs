//! The result of decoding an image file.

use super::colour::Conversion;
use super::{Image, linear_from_srgb, srgb_from_linear};

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
    /// A value is beyond the levels of the set.
    pub(super) is_beyond: bool,
    /// What is unusual about the values, without the file's name.
    pub(super) remark: Option<String>,
}

impl DecodedImage {
    /// Values that are not colours, or are sRGB already.
    pub(super) fn as_stored(image: Image, alpha: Option<Image>) -> Self {
        Self { image, alpha, conversion: Conversion::default(), is_beyond: false, remark: None }
    }

    /// Reduced to another size by the mean of linear light.
    pub(super) fn resized_to(mut self, size: Option<(u32, u32)>) -> Self {
        let Some((width, height)) = size else { return self };
        self.image.data.iter_mut().for_each(|x| *x = linear_from_srgb(*x));
        self.image = self.image.resized(width, height);
        self.image.data.iter_mut().for_each(|x| *x = srgb_from_linear(*x));
        self.alpha = self.alpha.map(|alpha| alpha.resized(width, height));
        self
    }
}
