//! Masks of views: `masks/NAME.png`, or `masks/NAME.jpg.png` as COLMAP calls them, and the photographs' own alpha.

use std::path::{Path, PathBuf};

use super::listed::ListedView;
use super::prepare::prepared;
use super::undistort::Undistortion;
use crate::Result;
use crate::camera::Lens;
use crate::photographs::image::files::Files;
use crate::photographs::image::{Mask, Orientation};

/// Where masks lie below the root.
const FOLDER: &str = "masks";

/// The mask of a photograph.
pub(super) fn find(root: &Path, frame: &ListedView, files: &Files) -> Option<PathBuf> {
    let folder = root.join(FOLDER);
    let file = frame.file.as_ref().and_then(|file| file.file_name()?.to_str());
    let names = [frame.below.clone(), frame.below.clone() + ".png"];
    let of_file = file.map(|file| format!("{file}.png"));
    names.into_iter().chain(of_file).find_map(|name| files.find(&folder, &name))
}

/// Which pixels of a view count, as its camera sees them, of its mask as its photograph is stored; none where all do.
pub(super) fn seen(
    stored: &Mask,
    photograph: &Path,
    (lens, orientation): (&Lens, Orientation),
    undistortion: Option<&Undistortion>,
    size: (u32, u32),
) -> Result<Option<Mask>> {
    let plane = stored.to_image().turned(orientation);
    Ok(Mask::of_plane(&prepared(plane, photograph, lens, undistortion, size)?))
}
