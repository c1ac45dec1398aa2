//! Finds photographs: all of a folder, or one by its listed path, with or without extension.

use std::cell::RefCell;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use nightsplat_core::{Result, input};
use unicode_normalization::UnicodeNormalization;

use crate::tree;

/// Extensions of the files that [`super::ImageFile::load`] reads.
const READABLE: [&str; 7] = ["png", "jpg", "jpeg", "exr", "tif", "tiff", "webp"];
/// Extensions of other images and clips. Any other suffix after a dot belongs to the name.
const UNREADABLE: [&str; 10] =
    ["bmp", "hdr", "gif", "avif", "jxl", "heic", "heif", "mp4", "mov", "mkv"];
/// Extensions of camera RAW, which is read with the feature `raw`.
const RAW: [&str; 10] = ["dng", "cr2", "cr3", "nef", "arw", "raf", "rw2", "orf", "pef", "srw"];
/// Whether camera RAW is read.
pub(super) const READS_RAW: bool = cfg!(feature = "raw");
/// The remedy if it is not.
pub(super) const RAW_REMEDY: &str =
    "install nightsplat with `--features raw`, or convert it to 16-bit TIFF or EXR";

/// Whether a file is camera RAW, by its name: its content begins like a TIFF.
pub(super) fn is_raw(path: &Path) -> bool {
    is_one_of(&RAW, &path.extension().unwrap_or_default().to_string_lossy())
}

/// Images that other programs convert: their kind, extensions, and the programs.
pub(super) const CONVERTIBLE: [(&str, &[&str], &str); 4] = [
    (
        "HEIC",
        &["heic", "heif"],
        "convert it first, `heif-convert IN.heic OUT.png` of libheif, or on macOS \
         `sips -s format png IN.heic --out OUT.png`",
    ),
    ("AVIF", &["avif"], "convert it first, `avifdec IN.avif OUT.png` of libavif"),
    ("JPEG XL", &["jxl"], "convert it first, `djxl IN.jxl OUT.png` of libjxl"),
    (
        "Radiance HDR",
        &["hdr"],
        "convert it to EXR first, `oiiotool IN.hdr -o OUT.exr` of OpenImageIO",
    ),
];

/// A photograph's name: the file name without an image's extension.
pub fn stem(listed: &str) -> &str {
    let name = listed.rsplit('/').next().unwrap_or(listed);
    match name.rsplit_once('.') {
        Some((stem, ending)) if is_one_of(&[&READABLE[..], &UNREADABLE, &RAW].concat(), ending) => {
            stem
        }
        _ => name,
    }
}

/// The photographs of a folder that can be read, by path.
pub fn photographs_in(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut paths = files_in(folder).map_err(|error| input::unreadable(folder, &error))?;
    paths.retain(|path| {
        let ending = path.extension().unwrap_or_default();
        is_one_of(&READABLE, &ending.to_string_lossy()) || READS_RAW && is_raw(path)
    });
    Ok(paths)
}

/// A line that counts the images and clips of a folder that are not read, by extension; `None` if there are none.
pub fn unread_in(folder: &Path) -> Option<String> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for path in files_in(folder).unwrap_or_default() {
        let ending = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        if is_one_of(&UNREADABLE, &ending) || !READS_RAW && is_raw(&path) {
            *counts.entry(ending).or_default() += 1;
        }
    }
    let listed: Vec<String> =
        counts.iter().map(|(ending, count)| format!("{count} .{ending}")).collect();
    let is_raw = counts.keys().any(|ending| is_one_of(&RAW, ending));
    let mut remedy = String::new();
    for (kind, endings, program) in CONVERTIBLE {
        if counts.keys().any(|ending| is_one_of(endings, ending)) {
            remedy += &format!("; {kind}: {program}");
        }
    }
    if is_raw {
        remedy += &format!("; RAW: {RAW_REMEDY}");
    }
    let folder = folder.display();
    (!listed.is_empty()).then(|| format!("{folder}: not read: {}{remedy}", listed.join(", ")))
}

/// Finds photographs, and caches the listings of folders.
#[derive(Debug, Default)]
pub struct PhotographFiles {
    folders: RefCell<HashMap<PathBuf, BTreeMap<String, PathBuf>>>,
}

impl PhotographFiles {
    /// The file `folder/listed`; without one, the file there that differs only in its extension or in the Unicode
    /// normalisation of its name. A path that leads out of an archive is not found.
    pub fn find(&self, folder: &Path, listed: &str) -> Option<PathBuf> {
        let exact = folder.join(listed);
        if tree::archive_of(folder).is_some_and(|archive| !exact.starts_with(archive)) {
            return None;
        }
        if tree::is_file(&exact) {
            return Some(exact);
        }
        let parent = exact.parent()?.to_owned();
        let mut folders = self.folders.borrow_mut();
        let by_stem = folders.entry(parent).or_insert_with_key(|parent| by_stem(parent));
        by_stem.get(&normalized(stem(listed))).cloned()
    }
}

/// A name in Unicode normalisation form C, for comparisons.
pub fn normalized(name: &str) -> String {
    if name.is_ascii() { name.to_owned() } else { name.nfc().collect() }
}

fn by_stem(folder: &Path) -> BTreeMap<String, PathBuf> {
    let paths = files_in(folder).unwrap_or_default().into_iter();
    let named = |path: PathBuf| Some((normalized(stem(path.file_name()?.to_str()?)), path));
    // Of two files with the same stem, the first by name is taken, in any order of the disk.
    paths.rev().filter_map(named).collect()
}

/// Every file of a folder, sorted, except those that begin with a dot: macOS writes `._NAME.JPG` next to every
/// photograph on foreign disks.
fn files_in(folder: &Path) -> std::io::Result<Vec<PathBuf>> {
    let mut paths = tree::entries(folder)?;
    paths.retain(|path| !is_hidden(path) && tree::is_file(path));
    paths.sort();
    Ok(paths)
}

/// Whether a file or folder begins with a dot, or is one that macOS adds to an archive.
pub fn is_hidden(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.starts_with('.') || name == "__MACOSX"
}

fn is_one_of(endings: &[&str], ending: &str) -> bool {
    endings.contains(&ending.to_ascii_lowercase().as_str())
}
