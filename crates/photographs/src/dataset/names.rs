//! Names of views: the photograph's file name, with the folder if several folders contain files of the same name, as
//! those of a rig.

use std::collections::BTreeSet;

use super::listed::ViewEntry;
pub(super) use crate::image::files::normalized;
use crate::image::files::stem;

/// A path as one file name, so that files of a view need no folders: `a_001` for `a/001.png`.
fn flat(path: &str) -> String {
    let folder = path.rsplit_once('/').map_or("", |(folder, _)| folder);
    let parts = folder.split('/').filter(|part| !part.is_empty() && *part != ".");
    normalized(&parts.chain([stem(path)]).collect::<Vec<_>>().join("_"))
}

/// The part of a path below its first folder.
pub(super) fn below_first(path: &str) -> &str {
    path.split_once('/').map_or(path, |(_, below)| below)
}

/// The possible names of a view whose photograph is listed at `path`, longest first.
pub(super) fn possible(path: &str) -> [String; 3] {
    let path = path.trim_start_matches("./");
    [flat(path), flat(below_first(path)), normalized(stem(path))]
}

/// Adds folders to all names if two photographs in different folders have the same name: the path below the folder of
/// all photographs, or the complete path if that is ambiguous as well (`train/r_0`, `test/r_0`). With one pose they are
/// one photograph that is listed twice (`low/0`, `high/0`), and nothing is renamed.
pub(super) fn disambiguate(frames: &mut [ViewEntry]) {
    let are_distinct =
        |names: &[String]| names.iter().collect::<BTreeSet<_>>().len() == names.len();
    let names: Vec<String> = frames.iter().map(|frame| frame.name.clone()).collect();
    let mut views = BTreeSet::new();
    let mut view = |frame: &ViewEntry| {
        let pose = frame.view_from_world.to_cols_array().map(f64::to_bits);
        views.insert((frame.name.clone(), pose))
    };
    if are_distinct(&names) || !frames.iter().all(&mut view) {
        return;
    }
    for path in [|frame: &ViewEntry| flat(&frame.below), |frame: &ViewEntry| flat(&frame.listed)] {
        let names: Vec<String> = frames.iter().map(path).collect();
        if are_distinct(&names) {
            frames.iter_mut().zip(names).for_each(|(frame, name)| frame.name = name);
            return;
        }
    }
}
