//! The split into training and test views.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use nightsplat_core::Result;

use super::listed::ViewEntry;
use super::{LoadOptions, Split, names};
use crate::image::files::PhotographFiles;
use crate::tree;

/// Every eighth of the name-sorted views is held out by default, and none of fewer.
pub(super) const TEST_EVERY: usize = 8;

/// The list of test photographs, next to the photographs or in the model, as in 3DGS.
pub(super) fn test_list(root: &Path) -> Option<PathBuf> {
    let paths = ["test.txt", "sparse/0/test.txt"].map(|path| root.join(path));
    paths.into_iter().find(|path| tree::is_file(path))
}

/// Assigns the frames, sorted by name, that the listing did not assign: by `test.txt` (a name per line), else every
/// eighth of those that have a photograph, if they are eight or more. With `test_every`, every Nth instead of any other
/// rule; 0: none.
pub(super) fn split(
    root: &Path,
    frames: &mut [ViewEntry],
    test_every: Option<usize>,
    files: &PhotographFiles,
) -> Result<()> {
    if let Some(every) = test_every {
        split_anew(root, frames, every, files);
        return Ok(());
    }
    let list = test_list(root);
    let mut undecided: Vec<&mut ViewEntry> =
        frames.iter_mut().filter(|frame| frame.split.is_none()).collect();
    let Some(path) = list.filter(|_| !undecided.is_empty()) else {
        let is_shown = |frame: &ViewEntry| frame.input(root, true, files).is_some();
        let shown = undecided.iter().filter(|frame| is_shown(frame)).count();
        let mut index = 0;
        for frame in undecided {
            let is_test = shown >= TEST_EVERY && is_shown(frame) && index % TEST_EVERY == 0;
            index += usize::from(is_shown(frame));
            frame.split = Some(if is_test { Split::Test } else { Split::Train });
        }
        return Ok(());
    };
    let text = tree::text(&path)?;
    let undecided_names: BTreeSet<String> =
        undecided.iter().map(|frame| frame.name.clone()).collect();
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let (mut held_out, mut unknown) = (BTreeSet::new(), BTreeSet::new());
    for line in lines {
        match names::possible(line).into_iter().find(|name| undecided_names.contains(name)) {
            Some(name) => held_out.insert(name),
            None => unknown.insert(line.to_owned()),
        };
    }
    for frame in &mut undecided {
        frame.split = Some(if held_out.contains(&frame.name) { Split::Test } else { Split::Train });
    }
    if let Some(name) = unknown.first() {
        tracing::warn!(
            "{}: {} names match no view, the first is {name}",
            path.display(),
            unknown.len()
        );
    }
    Ok(())
}

/// Warns if the dataset has a split that another one replaces.
pub(super) fn log_split(root: &Path, has_split: bool, options: &LoadOptions) {
    let source = if has_split {
        Some("its transforms files")
    } else {
        Some("its test.txt").filter(|_| test_list(root).is_some())
    };
    if let Some((source, every)) = source.zip(options.test_every) {
        tracing::warn!(
            "{}: {source} split the views, which gives way to test_every = {every}; scores do not compare with \
             those of its own split",
            root.display()
        );
    }
}

/// Holds out every Nth view by name that has a photograph, instead of the dataset's own split. A listed test view
/// without a dark photograph cannot be trained on: it stays a pose.
fn split_anew(root: &Path, frames: &mut [ViewEntry], every: usize, files: &PhotographFiles) {
    let training = frames.iter().filter(|frame| frame.split == Some(Split::Train));
    let training_folders: BTreeSet<String> =
        training.map(|frame| frame.folder().to_owned()).collect();
    let mut index = 0;
    for frame in frames {
        let lists_input =
            frame.split != Some(Split::Test) || training_folders.contains(frame.folder());
        if frame.input(root, lists_input, files).is_none() {
            frame.split = frame.split.or(Some(Split::Train));
            continue;
        }
        let is_test = every > 0 && index % every == 0;
        frame.split = Some(if is_test { Split::Test } else { Split::Train });
        index += 1;
    }
}
