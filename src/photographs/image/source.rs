//! Where the bytes of a picture come from, and what is said of those that are none.

use std::io::{BufRead, Seek};
use std::path::Path;

use ::image::ImageReader;

use crate::Error;

/// A file or memory, behind one type: every decoder is compiled anew for each that it reads from.
pub(super) trait Source: BufRead + Seek {}

impl<T: BufRead + Seek> Source for T {}

/// The reader of a picture, of the format that its content is of.
pub(super) fn reader<'a>(
    source: impl Source + 'a,
) -> std::io::Result<ImageReader<Box<dyn Source + 'a>>> {
    let source: Box<dyn Source> = Box::new(source);
    ImageReader::new(source).with_guessed_format()
}

/// The error of bytes that no decoder takes.
pub(super) fn not_an_image(path: &Path, error: &dyn std::error::Error) -> Error {
    Error::input(
        path,
        format!(
            "is not a readable PNG, JPEG, WebP, TIFF or EXR image ({error}); replace or remove it"
        ),
    )
}
