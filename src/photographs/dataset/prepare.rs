//! From a decoded picture to what its view shows.

use std::path::Path;

use super::undistort::Undistortion;
use crate::camera::Lens;
use crate::photographs::image::{Image, Orientation};
use crate::{Error, Result};

/// The picture as its view shows it: fitted to the lens, undistorted where that is asked for, and of `size`.
///
/// # Errors
/// Its shape is not that of the lens.
pub(super) fn prepared(
    image: Image,
    path: &Path,
    lens: &Lens,
    undistortion: Option<&Undistortion>,
    size: (u32, u32),
) -> Result<Image> {
    let (width, height) = (image.width, image.height);
    if lens.fitted(width, height).is_none() {
        return Err(disagreement(path, (width, height), lens));
    }
    // A reference image may be of another resolution than the input.
    let image = if (width, height) == (lens.width, lens.height) {
        image
    } else {
        image.resized(lens.width, lens.height)
    };
    let image = match undistortion {
        Some(undistortion) => undistortion.apply(&image),
        None => image,
    };
    Ok(if (image.width, image.height) == size { image } else { image.resized(size.0, size.1) })
}

pub(super) fn disagreement(path: &Path, (width, height): (u32, u32), lens: &Lens) -> Error {
    let (w, h) = (lens.width, lens.height);
    let (seen_width, seen_height) = Orientation::of(path).size((width, height));
    let seen = if seen_width == width {
        String::new()
    } else {
        format!(" (upright {seen_width}x{seen_height})")
    };
    let problem = format!(
        "is {width}x{height}{seen} but its camera is {w}x{h}; use the photographs that the cameras were made with"
    );
    Error::input(path, problem)
}
