//! The locations of listed photographs: their paths, or the same names elsewhere, since a listing may be from another
//! machine.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

use super::DARK_FOLDERS;
use super::listed::Listing;
use super::names::below_first;
use crate::image::MaskFile;
use crate::image::files::{PhotographFiles, is_hidden};
use crate::tree;

/// A listed photograph.
pub(super) struct Wanted {
    /// With slashes.
    pub(super) path: String,
    /// The folders that the path may be relative to.
    pub(super) folders: Vec<PathBuf>,
    /// Missing test photographs do not indicate that the listing is from another machine: some datasets withhold them.
    pub(super) is_test: bool,
}

/// The location of a photograph.
#[derive(Clone, Debug)]
pub(super) struct PhotographPath {
    /// Relative to the root; as listed if the file is missing or outside.
    pub(super) listed: String,
    /// Path relative to the common folder of all photographs.
    pub(super) below: String,
    pub(super) file: Option<PathBuf>,
}

/// Folders that tools write photographs to, in order of preference if several contain all names; the last ones are
/// downscaled.
const PREFERRED: [&str; 10] = [
    "low",
    "images_low",
    "images",
    "input",
    "rgb",
    "color",
    "images_2",
    "images_4",
    "images_8",
    "image",
];
/// Prefixes of folders that contain other files with the photographs' names.
const OTHERS: [&str; 8] =
    ["mask", "depth", "normal", "segment", "semantic", "dynamic_mask", "high", "flow"];
/// Depth and number of the folders in which photographs are searched.
const MOST_DEEP: usize = 3;
const MOST_FOLDERS: usize = 1000;

/// Finds the photographs: in `images` if given, or at their paths; missing ones under the same names in the only folder
/// with most of them, which is reported.
pub(super) fn photographs(
    root: &Path,
    images: Option<&Path>,
    wanted: Vec<Wanted>,
    files: &PhotographFiles,
    listing: &mut Listing,
) -> Vec<PhotographPath> {
    if let Some(folder) = images {
        return wanted.into_iter().map(|wanted| in_folder(root, folder, &wanted, files)).collect();
    }
    let mut found: Vec<PhotographPath> =
        wanted.iter().map(|wanted| at_path(root, wanted, files)).collect();
    let is_absent = |at: &usize| found[*at].file.is_none();
    let absent: Vec<usize> = (0..found.len()).filter(is_absent).collect();
    if absent.iter().any(|&at| !wanted[at].is_test) {
        let paths: Vec<&str> = absent.iter().map(|&at| wanted[at].path.as_str()).collect();
        let used: HashSet<PathBuf> = found.iter().filter_map(|found| found.file.clone()).collect();
        match elsewhere(root, &paths, &used, files) {
            Elsewhere::In(folder, rests) => {
                listing.remarks.push(format!(
                    "{}: {} of its photographs are not where it lists them ({} the first); those of the same names \
                     in {} are taken",
                    root.display(),
                    rests.iter().filter(|(_, file)| file.is_some()).count(),
                    paths.first().copied().unwrap_or_default(),
                    relative(root, &folder)
                ));
                for (at, (rest, file)) in absent.into_iter().zip(rests) {
                    if let Some(file) = file {
                        found[at] = moved(root, &folder, &rest, file);
                    }
                }
            }
            Elsewhere::InSeveral(folders) => listing.skipped.push(format!(
                "{}: {} photographs are not where it lists them ({} the first), and {} hold files of their \
                 names; choose one with --images",
                root.display(),
                paths.len(),
                paths.first().copied().unwrap_or_default(),
                folders.iter().map(|folder| relative(root, folder)).collect::<Vec<_>>().join(" and ")
            )),
            Elsewhere::Nowhere => {}
        }
    }
    found
}

/// Resolves the masks and depth maps of a listing; reports missing ones.
pub(super) fn beside(root: &Path, files: &PhotographFiles, listing: &mut Listing) {
    let Listing { frames, remarks, .. } = listing;
    let folders = folders_below(root, &[]);
    let find = |kind: &str, listed: &Path, photograph: Option<&PathBuf>| {
        let listed = listed.to_string_lossy();
        let name = listed.rsplit('/').next().unwrap_or(&listed);
        let beside = photograph.and_then(|file| file.parent()).map(Path::to_owned);
        let of_kind = folders.iter().filter(|folder| {
            let name = folder.file_name().unwrap_or_default().to_string_lossy();
            name.to_ascii_lowercase().contains(kind)
        });
        let elsewhere = of_kind.cloned().chain(beside).find_map(|folder| files.find(&folder, name));
        // A name without a distinct ending is also that of the photograph.
        files.find(root, &listed).or(elsewhere).filter(|file| Some(file) != photograph)
    };
    let mut absent: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for frame in frames {
        let photograph = frame.file.as_ref();
        let mut resolved = |kind, listed: &Path| {
            let file = find(kind, listed, photograph);
            if file.is_none() {
                absent.entry(kind).or_default().push(listed.to_string_lossy().into_owned());
            }
            file
        };
        let mask = frame.mask.take();
        frame.mask =
            mask.and_then(|mask| Some(MaskFile { path: resolved("mask", &mask.path)?, ..mask }));
        let depth = frame.depth.take();
        frame.depth = depth.and_then(|listed| resolved("depth", &listed));
    }
    for (kind, paths) in absent {
        let (count, first) = (paths.len(), &paths[0]);
        remarks.push(format!(
            "{}: {count} {kind} files that it names are absent, {first} the first",
            root.display()
        ));
    }
}

/// At the listed path.
fn at_path(root: &Path, wanted: &Wanted, files: &PhotographFiles) -> PhotographPath {
    for folder in &wanted.folders {
        if let Some(file) = files.find(folder, &wanted.path) {
            let folder = relative(root, folder);
            let listed = if folder == "." {
                wanted.path.clone()
            } else {
                format!("{folder}/{}", wanted.path)
            };
            return PhotographPath { below: below(wanted), listed, file: Some(file) };
        }
    }
    let is_elsewhere = wanted.path.starts_with('/') || wanted.path.contains(':');
    let listed = match wanted.folders.get(1) {
        Some(folder) if !is_elsewhere => format!("{}/{}", relative(root, folder), wanted.path),
        _ => wanted.path.clone(),
    };
    PhotographPath { below: below(wanted), listed, file: None }
}

/// The part of a listed path below the folder of all photographs: listings of several locations use it as a name.
fn below(wanted: &Wanted) -> String {
    let is_from_root = wanted.folders.len() < 2;
    if is_from_root { below_first(&wanted.path) } else { &wanted.path }.to_owned()
}

/// In a folder given by the user.
fn in_folder(
    root: &Path,
    folder: &Path,
    wanted: &Wanted,
    files: &PhotographFiles,
) -> PhotographPath {
    let path = wanted.path.as_str();
    let name = path.rsplit('/').next().unwrap_or(path);
    let found = [path, below_first(path), name]
        .into_iter()
        .find_map(|rest| Some((rest, files.find(folder, rest)?)));
    match found {
        Some((rest, file)) => moved(root, folder, rest, file),
        None => PhotographPath { below: below(wanted), listed: wanted.path.clone(), file: None },
    }
}

fn moved(root: &Path, folder: &Path, rest: &str, file: PathBuf) -> PhotographPath {
    let below_root = relative(root, folder);
    let (listed, below) = match below_root.as_str() {
        "." => (rest.to_owned(), below_first(rest).to_owned()),
        below_root => (format!("{below_root}/{rest}"), rest.to_owned()),
    };
    PhotographPath { listed, below, file: Some(file) }
}

fn relative(root: &Path, folder: &Path) -> String {
    match folder.strip_prefix(root) {
        Ok(below) if below.as_os_str().is_empty() => ".".to_owned(),
        Ok(below) => below.to_string_lossy().replace('\\', "/"),
        Err(_) => folder.to_string_lossy().into_owned(),
    }
}

/// Parts of a path that may be the same on another machine, and the file there.
type Rests = Vec<(String, Option<PathBuf>)>;

enum Elsewhere {
    In(PathBuf, Rests),
    InSeveral(Vec<PathBuf>),
    Nowhere,
}

/// The folder below the root that contains files of the same names.
fn elsewhere(
    root: &Path,
    paths: &[&str],
    used: &HashSet<PathBuf>,
    files: &PhotographFiles,
) -> Elsewhere {
    let folders = folders_below(root, &OTHERS);
    let mut candidates = best(&folders, &rests(paths), used, files);
    let rank = |folder: &Path| {
        let name = folder.file_name().unwrap_or_default().to_string_lossy();
        let dark = DARK_FOLDERS.contains(&&*name);
        let rank = PREFERRED.iter().position(|preferred| *preferred == name);
        rank.filter(|_| folder != root).unwrap_or(if dark { 0 } else { PREFERRED.len() })
    };
    candidates.sort_by_key(|(folder, _)| rank(folder));
    let ranks: Vec<usize> = candidates.iter().map(|(folder, _)| rank(folder)).collect();
    match (candidates.len(), ranks.as_slice()) {
        (0, _) => Elsewhere::Nowhere,
        (_, [first, second, ..]) if first == second => {
            Elsewhere::InSeveral(candidates.into_iter().map(|(folder, _)| folder).take(3).collect())
        }
        _ => {
            let (folder, rests) = candidates.swap_remove(0);
            Elsewhere::In(folder, rests)
        }
    }
}

/// The folders that contain the most files, at least half of them. Of the ways to shorten the paths, the longest with a
/// match is used.
fn best(
    folders: &[PathBuf],
    ways: &[Vec<String>],
    used: &HashSet<PathBuf>,
    files: &PhotographFiles,
) -> Vec<(PathBuf, Rests)> {
    for way in ways {
        let mut most = way.len().div_ceil(2).max(1);
        let mut candidates: Vec<(PathBuf, Rests)> = vec![];
        for folder in folders {
            let find = |rest: &String| files.find(folder, rest).filter(|file| !used.contains(file));
            let found: Rests = way.iter().map(|rest| (rest.clone(), find(rest))).collect();
            let distinct: HashSet<&PathBuf> =
                found.iter().filter_map(|(_, file)| file.as_ref()).collect();
            let count = distinct.len();
            if count > most {
                candidates.clear();
            }
            if count >= most {
                most = count;
                candidates.push((folder.clone(), found));
            }
        }
        if !candidates.is_empty() {
            return candidates;
        }
    }
    vec![]
}

/// The paths below their common folder, and the names alone.
fn rests(paths: &[&str]) -> Vec<Vec<String>> {
    let parts = |path: &&str| -> Vec<String> {
        let parts = path.split('/').filter(|part| !matches!(*part, "" | "." | ".."));
        parts.map(str::to_owned).collect()
    };
    let split: Vec<Vec<String>> = paths.iter().map(parts).collect();
    let Some(first) = split.first() else { return vec![] };
    let depth = split.iter().map(|parts| parts.len().saturating_sub(1)).min().unwrap_or(0);
    let is_shared = |at: &usize| split.iter().all(|parts| parts[*at] == first[*at]);
    let common = (0..depth).take_while(is_shared).count();
    let below = |from: usize| split.iter().map(|parts| parts[from..].join("/")).collect();
    let names = split.iter().map(|parts| parts.last().cloned().unwrap_or_default()).collect();
    let mut ways: Vec<Vec<String>> = vec![below(common), names];
    ways.dedup();
    ways
}

/// The root and the folders below it, except hidden ones and those with the given prefixes.
fn folders_below(root: &Path, without: &[&str]) -> Vec<PathBuf> {
    let mut found = vec![root.to_owned()];
    let mut level = vec![root.to_owned()];
    for _ in 0..MOST_DEEP {
        let mut next: Vec<PathBuf> = vec![];
        for folder in &level {
            let mut below = tree::entries(folder).unwrap_or_default();
            below.retain(|path| {
                let name =
                    path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
                let is_other = without.iter().any(|beginning| name.starts_with(beginning));
                !is_hidden(path) && !is_other && tree::is_dir(path)
            });
            below.sort();
            next.extend(below);
        }
        next.truncate(MOST_FOLDERS.saturating_sub(found.len()));
        found.extend(next.iter().cloned());
        level = next;
    }
    found
}
