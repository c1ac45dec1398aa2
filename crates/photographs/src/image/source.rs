//! Image files before decoding, and the error for bytes that are not an image.

use std::io::{BufRead, Seek};
use std::path::Path;

use ::image::error::UnsupportedErrorKind;
use ::image::{ImageError, ImageReader};
use nightsplat_core::Error;

/// A file or memory as one type: decoders are compiled for each type that they read from.
pub(super) trait BufReadSeek: BufRead + Seek {}

impl<T: BufRead + Seek> BufReadSeek for T {}

/// A reader of an image, for the format of its content.
pub(super) fn reader<'a>(
    source: impl BufReadSeek + 'a,
) -> std::io::Result<ImageReader<Box<dyn BufReadSeek + 'a>>> {
    let source: Box<dyn BufReadSeek> = Box::new(source);
    ImageReader::new(source).with_guessed_format()
}

/// The error for bytes that no decoder accepts.
pub(super) fn not_an_image(path: &Path, error: &dyn std::error::Error) -> Error {
    let problem = format!(
        "is not a readable PNG, JPEG, WebP, TIFF or EXR image ({error}); replace or remove it"
    );
    Error::input(path, problem)
}

/// Distinguishes damaged files from unsupported ones, such as a TIFF of floats, which may or may not be linear light.
pub(super) fn undecodable(path: &Path, error: &ImageError) -> Error {
    match error {
        ImageError::Unsupported(kind)
            if !matches!(kind.kind(), UnsupportedErrorKind::Format(_)) =>
        {
            let problem =
                format!("is not read ({kind}); save it with 8 or 16 bits, or linear light as EXR");
            Error::input(path, problem)
        }
        ImageError::Limits(limit) => Error::input(
            path,
            format!("needs more memory than decoders may take ({limit}); crop or shrink it"),
        ),
        damage => not_an_image(path, damage),
    }
}
