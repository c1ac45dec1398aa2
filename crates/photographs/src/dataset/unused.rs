//! Files next to a dataset's photographs that are not used, which are reported.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::listed::ViewEntry;
use super::masks;
use crate::image::files::{photographs_in, unread_in};
use crate::tree;

/// A line if most photographs have no pose, and one for each folder of images that are not read.
pub(super) fn remarks(root: &Path, frames: &[ViewEntry]) -> Vec<String> {
    let used: BTreeSet<&Path> = frames.iter().filter_map(|frame| frame.file.as_deref()).collect();
    let images = root.join("images");
    let all_below = used.iter().any(|file| file.starts_with(&images));
    let mut folders: BTreeSet<PathBuf> =
        used.iter().filter_map(|file| file.parent()).map(Path::to_owned).collect();
    if all_below {
        add_folders_below(&images, &mut folders);
    }
    // Next to a folder of dark photographs, its normal-light counterpart has the other half of the listing.
    let stems: BTreeSet<_> = used.iter().filter_map(|file| file.file_stem()).collect();
    let is_used = |file: &PathBuf| {
        let has_twin =
            !file.starts_with(&images) && stems.contains(&file.file_stem().unwrap_or_default());
        used.contains(file.as_path()) || has_twin
    };
    let photographs: Vec<PathBuf> =
        folders.iter().flat_map(|folder| photographs_in(folder).unwrap_or_default()).collect();
    let without_pose: Vec<&PathBuf> =
        photographs.iter().filter(|file| !is_used(file) && !masks::is_beside(file)).collect();
    let mut remarks = vec![];
    let (count, of) = (without_pose.len(), photographs.len());
    if let Some(first) = without_pose.first().filter(|_| 2 * count > of) {
        let first = first.strip_prefix(root).unwrap_or(first).display();
        remarks.push(format!(
            "{}: {count} of {of} photographs have no pose and are not used, {first} the first; `nightsplat pose` \
             finds those of dark photographs",
            root.display()
        ));
    }
    remarks.extend(folders.iter().filter_map(|folder| unread_in(folder)));
    remarks
}

fn add_folders_below(folder: &Path, folders: &mut BTreeSet<PathBuf>) {
    folders.insert(folder.to_owned());
    for path in tree::entries(folder).unwrap_or_default() {
        // A link may lead back up.
        if tree::is_dir(&path) && !path.is_symlink() {
            add_folders_below(&path, folders);
        }
    }
}
