//! Finding photographs: by the path a listing gives, with or without extension, or by stem in another folder.

use std::cell::RefCell;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

/// Endings of image files, readable or not: what follows another dot belongs to the name.
const EXTENSIONS: [&str; 9] = ["png", "jpg", "jpeg", "exr", "tif", "tiff", "webp", "bmp", "hdr"];

/// A photograph's name: the file name without an image's extension.
pub(super) fn stem(listed: &str) -> &str {
    let name = listed.rsplit('/').next().unwrap_or(listed);
    match name.rsplit_once('.') {
        Some((stem, extension))
            if EXTENSIONS.contains(&extension.to_ascii_lowercase().as_str()) =>
        {
            stem
        }
        _ => name,
    }
}

/// Looks photographs up and remembers what the folders hold.
#[derive(Debug, Default)]
pub(super) struct Files {
    folders: RefCell<HashMap<PathBuf, BTreeMap<String, PathBuf>>>,
}

impl Files {
    /// The file at `folder/listed`; where there is none, the one there that differs by its extension only.
    pub(super) fn find(&self, folder: &Path, listed: &str) -> Option<PathBuf> {
        let exact = folder.join(listed);
        if exact.is_file() {
            return Some(exact);
        }
        let parent = exact.parent()?.to_owned();
        let mut folders = self.folders.borrow_mut();
        let by_stem = folders.entry(parent).or_insert_with_key(|parent| by_stem(parent));
        by_stem.get(stem(listed)).cloned()
    }
}

fn by_stem(folder: &Path) -> BTreeMap<String, PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> =
        entries.map(|entry| entry.path()).filter(|path| path.is_file()).collect();
    // Of two files with one stem the first by name, whatever order the disk lists them in.
    paths.sort_by(|a, b| b.cmp(a));
    let named = |path: PathBuf| Some((stem(path.file_name()?.to_str()?).to_owned(), path));
    paths.into_iter().filter_map(named).collect()
}
