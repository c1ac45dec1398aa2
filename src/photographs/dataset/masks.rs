//! Masks of views: `masks/NAME.png`, or `masks/NAME.jpg.png` as COLMAP calls them, and the photographs' own alpha.

use std::path::{Path, PathBuf};

use super::listed::ListedView;
use crate::photographs::image::files::Files;

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
