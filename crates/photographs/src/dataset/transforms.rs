//! NeRF-style listings: `transforms_{train,test,val}.json` or one `transforms.json`.
//!
//! `transform_matrix` is view to world in OpenGL axes (x right, y up, z back). Intrinsics are at the top level, in a
//! frame, or both: the frame's take precedence.

mod intrinsics;
mod keys;
mod matrix;

use std::path::{Path, PathBuf};

use glam::DAffine3;
use nightsplat_core::{Error, Result};
use serde::Deserialize;
use serde_json::{Map, Value};

use self::intrinsics::Intrinsics;
use self::keys::Unsupported;
use self::matrix::Rows;
use super::listed::{Listing, ViewEntry};
use super::locate::{self, Wanted};
use super::ply::Cloud;
use super::{Split, names};
use crate::image::MaskFile;
use crate::image::files::{PhotographFiles, stem};
use crate::tree;

#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    shared: Intrinsics,
    frames: Vec<FrameEntry>,
    /// Held-out frames in the same format (`ScanNet++`).
    #[serde(default)]
    test_frames: Vec<FrameEntry>,
    ply_file_path: Option<String>,
    /// 3x4 rows: from the world of the original data to that of the frames (nerfstudio).
    applied_transform: Option<Rows>,
    #[serde(flatten)]
    splits: StatedSplits,
    #[serde(flatten)]
    others: Map<String, Value>,
}

/// File names by split (nerfstudio).
#[derive(Deserialize)]
struct StatedSplits {
    train_filenames: Option<Vec<String>>,
    val_filenames: Option<Vec<String>>,
    test_filenames: Option<Vec<String>>,
}

#[derive(Deserialize)]
struct FrameEntry {
    file_path: String,
    #[serde(deserialize_with = "matrix::rows")]
    transform_matrix: Rows,
    #[serde(flatten)]
    intrinsics: Intrinsics,
    mask_path: Option<String>,
    #[serde(alias = "depth_path")]
    depth_file_path: Option<String>,
    split: Option<String>,
    #[serde(flatten)]
    others: Map<String, Value>,
}

/// The files of a listing below `root`, with the split of each; empty if there is none.
///
/// `transforms_val.json` often repeats test views: it is used only if there is no test listing.
pub(super) fn find(root: &Path) -> Vec<(PathBuf, Option<Split>)> {
    let existing = |name: &str| Some(root.join(name)).filter(|path| tree::is_file(path));
    let held_out = existing("transforms_test.json").or_else(|| existing("transforms_val.json"));
    match (existing("transforms_train.json"), held_out) {
        (Some(train), Some(test)) => vec![(train, Some(Split::Train)), (test, Some(Split::Test))],
        (Some(single), None) => vec![(single, None)],
        (None, _) => existing("transforms.json").map(|single| (single, None)).into_iter().collect(),
    }
}

/// A parsed file of a listing.
struct Read<'a> {
    path: &'a Path,
    transforms: Transforms,
}

/// Reads the files of a listing; frames without a usable pose or size are added to `skipped`.
pub(super) fn read(
    root: &Path,
    images: Option<&Path>,
    listings: &[(PathBuf, Option<Split>)],
    files: &PhotographFiles,
    listing: &mut Listing,
) -> Result<()> {
    let mut frames = vec![];
    let mut read = vec![];
    for (path, split) in listings {
        let mut transforms = parse(path)?;
        let usable = usable_frames(path, &mut transforms, *split, listing);
        frames.extend(usable.into_iter().map(|frame| (read.len(), frame)));
        read.push(Read { path, transforms });
    }
    let wanted = frames.iter().map(|(_, frame)| Wanted {
        is_test: frame.split == Some(Split::Test),
        path: listed_path(&frame.listed.file_path),
        folders: vec![root.to_owned()],
    });
    let found = locate::photographs(root, images, wanted.collect(), files, listing);
    for ((file, frame), found) in frames.into_iter().zip(found) {
        let Read { path, transforms } = &read[file];
        let listed = frame.listed;
        let intrinsics = listed.intrinsics.over(&transforms.shared);
        let Some(size) = intrinsics.size(found.file.as_deref()) else {
            listing.skipped.push(format!(
                "{}: neither w and h nor a readable file says how large it is",
                found.listed
            ));
            continue;
        };
        let lens = intrinsics
            .lens(size)
            .map_err(|problem| Error::input(*path, format!("{}: {problem}", found.listed)))?;
        let mask = listed.mask_path.map(|path| MaskFile::shown(listed_path(&path).into()));
        listing.frames.push(ViewEntry {
            name: names::normalized(stem(&found.listed)),
            listed: found.listed,
            below: found.below,
            split: frame.split,
            file: found.file,
            lens,
            view_from_world: frame.view_from_world,
            mask,
            depth: listed.depth_file_path.map(|path| listed_path(&path).into()),
        });
    }
    locate::beside(root, files, listing);
    for Read { path, transforms } in &read {
        listing.clouds.extend(cloud(root, path, transforms, &mut listing.remarks));
    }
    Ok(())
}

fn parse(path: &Path) -> Result<Transforms> {
    let text = tree::text(path)?;
    serde_json::from_str(&nan_as_null(&text)).map_err(|error| {
        let remedy = if error.is_eof() {
            "it is cut short, copy it again"
        } else {
            "mend or export it anew"
        };
        Error::input(path, format!("is not a usable transforms file ({error}); {remedy}"))
    })
}

/// A normalised path for comparison: with slashes, without `.` components.
fn listed_path(path: &str) -> String {
    let path = path.replace('\\', "/");
    path.trim_start_matches("./").to_owned()
}

/// A frame with its pose.
struct PosedFrame {
    listed: FrameEntry,
    split: Option<Split>,
    view_from_world: DAffine3,
}

/// Adds the frames of a file that have a pose and are not marked as bad.
fn usable_frames(
    path: &Path,
    transforms: &mut Transforms,
    split: Option<Split>,
    listing: &mut Listing,
) -> Vec<PosedFrame> {
    let mut unsupported = Unsupported::default();
    unsupported.add(&transforms.others);
    let held_out = std::mem::take(&mut transforms.test_frames);
    let frames = std::mem::take(&mut transforms.frames).into_iter();
    let split_of_training = if held_out.is_empty() { split } else { Some(Split::Train) };
    let all: Vec<(FrameEntry, Option<Split>)> = frames
        .map(|frame| (frame, split_of_training))
        .chain(held_out.into_iter().map(|frame| (frame, Some(Split::Test))))
        .collect();
    let is_transposed =
        matrix::are_transposed(all.iter().map(|(frame, _)| &frame.transform_matrix));
    let mut mended = Mended { is_transposed, ..Mended::default() };
    let (mut bad, mut unassigned) = (0, 0);
    let mut frames = vec![];
    for (listed, split) in all {
        let name = listed_path(&listed.file_path);
        if keys::is_marked_bad(&listed.others) {
            bad += 1;
            continue;
        }
        unsupported.add(&listed.others);
        let Some(split) = transforms.splits.stated(&name, listed.split.as_deref(), split) else {
            unassigned += 1;
            continue;
        };
        match matrix::pose(&listed.transform_matrix, is_transposed) {
            Err(problem) => listing.skipped.push(format!(
                "{name}: its transform_matrix {problem}; export it right-handed, in OpenGL axes"
            )),
            Ok(pose) => {
                mended.add(&pose);
                let view_from_world = pose.view_from_world;
                frames.push(PosedFrame { listed, split, view_from_world });
            }
        }
    }
    let shown = path.display();
    let mut add_remark = |line: Option<String>| listing.remarks.extend(line);
    add_remark(unsupported.remark(path));
    add_remark(mended.remark(path));
    add_remark((bad > 0).then(|| format!("{shown}: {bad} frames are marked bad and left out")));
    add_remark((unassigned > 0).then(|| {
        format!("{shown}: {unassigned} frames are in none of its lists of file names by split, and left out")
    }));
    frames
}

/// Corrections of the matrices of a file.
#[derive(Default)]
struct Mended {
    is_transposed: bool,
    scaled: usize,
    scale: f64,
    rounded: usize,
}

impl Mended {
    fn add(&mut self, pose: &matrix::Pose) {
        if pose.scale != 1.0 {
            self.scaled += 1;
            self.scale = pose.scale;
        }
        self.rounded += usize::from(pose.is_rounded);
    }

    fn remark(&self, path: &Path) -> Option<String> {
        let mut parts = vec![];
        if self.is_transposed {
            parts.push("are transposed (the translation is their last row) and read so".to_owned());
        }
        if self.scaled > 0 {
            parts.push(format!(
                "hold a scale ({} of them, {:.4} the last), which is divided out",
                self.scaled, self.scale
            ));
        }
        if self.rounded > 0 {
            parts.push(format!(
                "are rounded ({} of them): the nearest rotation is taken",
                self.rounded
            ));
        }
        (!parts.is_empty())
            .then(|| format!("{}: its matrices {}", path.display(), parts.join("; ")))
    }
}

impl StatedSplits {
    /// The split of a frame by its own key, else by the lists, else `default`; `None` if there are lists, but the frame
    /// is in none. As with files, a validation list is used only if there is no test list.
    fn stated(
        &self,
        name: &str,
        key: Option<&str>,
        default: Option<Split>,
    ) -> Option<Option<Split>> {
        match key {
            Some("train") => return Some(Some(Split::Train)),
            Some("test" | "val" | "eval") => return Some(Some(Split::Test)),
            _ => {}
        }
        let filled =
            |list: &Option<Vec<String>>| list.as_ref().is_some_and(|list| !list.is_empty());
        let lists = [&self.train_filenames, &self.val_filenames, &self.test_filenames];
        if !lists.into_iter().any(filled) {
            return Some(default);
        }
        let held_out =
            if filled(&self.test_filenames) { &self.test_filenames } else { &self.val_filenames };
        let holds = |list: &Option<Vec<String>>| {
            list.iter().flatten().any(|listed| listed_path(listed) == name)
        };
        let train_is_listed = filled(&self.train_filenames);
        match (holds(&self.train_filenames), holds(held_out)) {
            (_, true) => Some(Some(Split::Test)),
            (true, false) => Some(Some(Split::Train)),
            (false, false) if train_is_listed && filled(held_out) => None,
            (false, false) if train_is_listed => Some(Some(Split::Test)),
            (false, false) => Some(Some(Split::Train)),
        }
    }
}

/// The points that a listing names.
fn cloud(
    root: &Path,
    path: &Path,
    transforms: &Transforms,
    remarks: &mut Vec<String>,
) -> Option<Cloud> {
    let named = listed_path(transforms.ply_file_path.as_ref()?);
    let name = named.rsplit('/').next().unwrap_or(&named);
    let files = [root.join(&named), path.with_file_name(name)];
    let Some(file) = files.into_iter().find(|file| tree::is_file(file)) else {
        remarks.push(format!("{}: {named}, its ply_file_path, is absent", path.display()));
        return None;
    };
    let applied = transforms.applied_transform.as_ref();
    Some(Cloud { file, applied: applied.and_then(|rows| matrix::affine(rows, false)) })
}

/// Replaces the bare NaN and Infinity of Python, which are not JSON, by null, which is reported with its frame.
fn nan_as_null(text: &str) -> String {
    let quoted = |(index, part): (usize, &str)| match index % 2 {
        0 => part.replace("-Infinity", "null").replace("Infinity", "null").replace("NaN", "null"),
        _ => part.to_owned(),
    };
    // Text between quotes is unchanged; an escaped quote swaps inside and outside, so a file with one is left alone.
    if text.contains("\\\"") {
        return text.to_owned();
    }
    text.split('"').enumerate().map(quoted).collect::<Vec<_>>().join("\"")
}
