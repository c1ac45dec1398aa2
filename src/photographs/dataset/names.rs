//! Names of views: by the photograph's file, and where folders hold equal files, as those of a rig do, by folder and file.

use std::collections::BTreeSet;

use super::listed::ListedView;
use crate::photographs::image::files::stem;

/// A path as one file name, so that what is written of a view needs no folders: `a_001` of `a/001.png`.
fn flat(path: &str) -> String {
    let folder = path.rsplit_once('/').map_or("", |(folder, _)| folder);
    let parts = folder.split('/').filter(|part| !part.is_empty() && *part != ".");
    parts.chain([stem(path)]).collect::<Vec<_>>().join("_")
}

/// What lies below the first folder of a path.
pub(super) fn below_first(path: &str) -> &str {
    path.split_once('/').map_or(path, |(_, below)| below)
}

/// The names that a view may have whose photograph is listed at `path`, the longest first.
pub(super) fn possible(path: &str) -> [String; 3] {
    let path = path.trim_start_matches("./");
    [flat(path), flat(below_first(path)), stem(path).to_owned()]
}

/// Puts the folder into every name where two photographs in different folders have one.
pub(super) fn disambiguate(frames: &mut [ListedView]) {
    let mut names = BTreeSet::new();
    if !frames.iter().all(|frame| names.insert(frame.name.as_str())) {
        frames.iter_mut().for_each(|frame| frame.name = flat(&frame.below));
    }
}
