//! Sources of image bytes, and the error for bytes that are not an image.

use std::io::{BufRead, Seek};
use std::path::Path;

use ::image::ImageReader;

use crate::Error;

/// A file or memory as one type: decoders are compiled for each type that they read from.
pub(super) trait Source: BufRead + Seek {}

impl<T: BufRead + Seek> Source for T {}

/// A reader of an image, for the format of its content.
pub(super) fn reader<'a>(
    source: impl Source + 'a,
) -> std::io::Result<ImageReader<Box<dyn Source + 'a>>> {
    let source: Box<dyn Source> = Box::new(source);
    ImageReader::new(source).with_guessed_format()
}

/// The error for bytes that no decoder accepts.
pub(super) fn not_an_image(path: &Path, error: &dyn std::error::Error) -> Error {
    Error::input(
        path,
        format!(
            "is not a readable PNG, JPEG, WebP, TIFF or EXR image ({error}); replace or remove it"
        ),
    )
}
