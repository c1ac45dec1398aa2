//! Names of views: by the photograph's file, and where folders hold equal files, as those of a rig do, by folder and file.

use std::collections::BTreeSet;

use super::listed::ListedView;
pub(super) use crate::photographs::image::files::normalized;
use crate::photographs::image::files::stem;

/// A path as one file name, so that what is written of a view needs no folders: `a_001` of `a/001.png`.
fn flat(path: &str) -> String {
    let folder = path.rsplit_once('/').map_or("", |(folder, _)| folder);
    let parts = folder.split('/').filter(|part| !part.is_empty() && *part != ".");
    normalized(&parts.chain([stem(path)]).collect::<Vec<_>>().join("_"))
}

/// What lies below the first folder of a path.
pub(super) fn below_first(path: &str) -> &str {
    path.split_once('/').map_or(path, |(_, below)| below)
}

/// The names that a view may have whose photograph is listed at `path`, the longest first.
pub(super) fn possible(path: &str) -> [String; 3] {
    let path = path.trim_start_matches("./");
    [flat(path), flat(below_first(path)), normalized(stem(path))]
}

/// Puts folders into every name where two photographs in different folders have one: those below the folder of all
/// photographs, or where these are equal as well (`train/r_0`, `test/r_0`) all of the path. Of one pose they are one photograph
/// that is listed twice (`low/0`, `high/0`), and nothing is renamed.
pub(super) fn disambiguate(frames: &mut [ListedView]) {
    let are_distinct =
        |names: &[String]| names.iter().collect::<BTreeSet<_>>().len() == names.len();
    let own: Vec<String> = frames.iter().map(|frame| frame.name.clone()).collect();
    let mut views = BTreeSet::new();
    let mut view = |frame: &ListedView| {
        let pose = frame.view_from_world.to_cols_array().map(f64::to_bits);
        views.insert((frame.name.clone(), pose))
    };
    if are_distinct(&own) || !frames.iter().all(&mut view) {
        return;
    }
    for path in [|frame: &ListedView| flat(&frame.below), |frame: &ListedView| flat(&frame.listed)]
    {
        let names: Vec<String> = frames.iter().map(path).collect();
        if are_distinct(&names) {
            frames.iter_mut().zip(names).for_each(|(frame, name)| frame.name = name);
            return;
        }
    }
}
