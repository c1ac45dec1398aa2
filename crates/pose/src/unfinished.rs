//! The dataset while it is written.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use nightsplat_core::lock::FolderLock;
use nightsplat_core::output::{create_folder, write_whole};
use nightsplat_photographs::dataset::{Dataset, is_mask, mask_beside};
use nightsplat_photographs::image::files::{PhotographFiles, photographs_in, stem};
use nightsplat_photographs::tree;

use super::pictures::{BRIGHT, PosePhotographs};
use nightsplat_core::{Error, Result, Stop};

/// Creates a hard link in `folder`, or a copy if the file system has no links.
fn link_or_copy(from: &Path, folder: &Path) -> Result<()> {
    link_or_copy_to(from, &folder.join(from.file_name().unwrap_or_default()))
}

/// [`link_or_copy`] under another name.
pub(super) fn link_or_copy_to(from: &Path, to: &Path) -> Result<()> {
    if tree::archive_of(from).is_some() {
        return write_whole(to, &tree::bytes(from)?);
    }
    let from = from.canonicalize().unwrap_or_else(|_| from.to_owned());
    // Of an earlier call that was killed.
    let _ = fs::remove_file(to);
    if fs::hard_link(&from, to).is_ok() {
        return Ok(());
    }
    fs::copy(&from, to)
        .map(drop)
        .map_err(|error| Error::output(to, format!("cannot be written: {error}")))
}

/// A dataset under a temporary name, with what its programs have found so far. Another call goes on with what a killed
/// process left; what failed is removed.
pub(super) struct Unfinished {
    target: PathBuf,
    replaces: bool,
    /// The folder that becomes the dataset.
    folder: PathBuf,
    /// Working folder of COLMAP.
    pub(super) work: PathBuf,
    /// Output of the programs.
    pub(super) log: PathBuf,
    /// On the folder.
    pub(super) lock: FolderLock,
    /// Whether the folder stays: it is the dataset, or another call goes on with it.
    stays: bool,
}

impl Unfinished {
    /// Begins a dataset, or goes on with one of the same `origin`: its photographs and options, in a line.
    pub(super) fn open(target: &Path, overwrite: bool, origin: &str) -> Result<Self> {
        let mut folder = target.as_os_str().to_owned();
        folder.push(".partial");
        let folder = PathBuf::from(folder);
        let has_files =
            |folder: &Path| fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_some());
        let is_ours = target.join(LOG).is_file();
        if target.is_file() || (has_files(target) && !(overwrite && is_ours)) {
            let remedy = if is_ours {
                "pass --overwrite, or choose another folder"
            } else {
                "choose another folder"
            };
            return Err(Error::output(target, format!("exists already; {remedy}")));
        }
        if has_files(&folder) && !folder.join(ORIGIN).is_file() {
            let problem = "is in the way, and not of `nightsplat pose`; remove it";
            return Err(Error::output(folder, problem));
        }
        create_folder(&folder)?;
        let lock = FolderLock::take(&folder)?;
        let work = folder.join(WORK);
        if origin_of(&folder).as_deref() != Some(origin) {
            for name in [WORK, "images", "masks", "sparse", BRIGHT] {
                // Most of them are absent.
                let _ = fs::remove_dir_all(folder.join(name));
            }
            write_whole(&folder.join(ORIGIN), origin.as_bytes())?;
        }
        create_folder(&work)?;
        let log = folder.join(LOG);
        let replaces = has_files(target);
        Ok(Self { target: target.to_owned(), replaces, folder, work, log, lock, stays: false })
    }

    /// The seconds that a stage took, if it is done; work in several calls counts from the last on.
    pub(super) fn seconds_of(&self, stage: &str) -> Option<f64> {
        fs::read_to_string(self.mark(stage)).ok()?.trim().parse().ok()
    }

    /// Records that a stage is done.
    pub(super) fn done(&self, stage: &str, seconds: f64) -> Result<()> {
        write_whole(&self.mark(stage), format!("{seconds:.3}\n").as_bytes())
    }

    fn mark(&self, stage: &str) -> PathBuf {
        self.work.join(format!("{stage}.done"))
    }

    /// The error of work that was stopped in a stage.
    pub(super) fn stopped(&self, stage: &str, cause: Stop) -> Error {
        Error::StageStopped { folder: self.target.clone(), stage: stage.to_owned(), cause }
    }

    /// Keeps the folder for another call.
    pub(super) fn keep(&mut self) {
        self.stays = true;
    }

    /// Adds those of `photographs` that are placed, by their names without extension, to the dataset `below` this one.
    pub(super) fn add_photographs(
        &self,
        below: &str,
        photographs: &[PathBuf],
        placed: &[String],
    ) -> Result<()> {
        let by_name: BTreeMap<&str, &PathBuf> = photographs
            .iter()
            .filter_map(|path| Some((stem(path.file_name()?.to_str()?), path)))
            .collect();
        let images = self.folder.join(below).join("images");
        create_folder(&images)?;
        let placed = placed.iter().filter_map(|name| by_name.get(stem(name)));
        placed.into_iter().try_for_each(|path| link_or_copy(path, &images))
    }

    /// Adds the masks in `masks` of the source folder and, unless it is a clip, those next to the photographs.
    pub(super) fn add_masks(&self, source: &Path, is_clip: bool) -> Result<()> {
        let masks = source.join("masks");
        if masks.is_dir() {
            let folder = self.folder.join("masks");
            create_folder(&folder)?;
            photographs_in(&masks)?.iter().try_for_each(|mask| link_or_copy(mask, &folder))?;
        }
        if is_clip {
            return Ok(());
        }
        let images = self.folder.join("images");
        let files = photographs_in(source)?;
        files.iter().filter(|file| is_mask(file)).try_for_each(|mask| link_or_copy(mask, &images))
    }

    /// Adds the masks that COLMAP had of those of `photographs` that are placed and have no mask of their own to the
    /// dataset `below` this one.
    pub(super) fn add_masks_in_place(
        &self,
        below: &str,
        pictures: &PosePhotographs,
        photographs: &[PathBuf],
        placed: &[String],
    ) -> Result<()> {
        let (folder, files) = (self.folder.join(below).join("masks"), PhotographFiles::default());
        let placed: BTreeSet<&str> = placed.iter().map(|name| stem(name)).collect();
        for photograph in photographs {
            let name = photograph.file_name().unwrap_or_default().to_string_lossy();
            let (name, mask) = (stem(&name), pictures.mask(photograph));
            if placed.contains(name) && mask.is_file() && mask_beside(photograph, &files).is_none()
            {
                create_folder(&folder)?;
                link_or_copy_to(&mask, &folder.join(format!("{name}.png")))?;
            }
        }
        Ok(())
    }

    /// Adds the files of a COLMAP model to the dataset `below` this one; where names are given anew, with the images
    /// that have one. Returns their folder.
    pub(super) fn add_model(
        &self,
        below: &str,
        model: &Path,
        renamed: Option<impl Fn(&str) -> Option<String>>,
    ) -> Result<PathBuf> {
        let sparse = self.folder.join(below).join("sparse/0");
        create_folder(&sparse)?;
        for file in ["cameras.bin", "points3D.bin"] {
            link_or_copy(&model.join(file), &sparse)?;
        }
        let images = model.join("images.bin");
        match renamed {
            None => link_or_copy(&images, &sparse)?,
            Some(renamed) => {
                let images = Dataset::images_renamed(&images, renamed)?;
                write_whole(&sparse.join("images.bin"), &images)?;
            }
        }
        Ok(sparse)
    }

    /// Where the log of a failed attempt is kept.
    pub(super) fn kept_log(&self) -> PathBuf {
        let mut path = self.target.as_os_str().to_owned();
        path.push(".");
        path.push(LOG);
        path.into()
    }

    /// Gives the dataset its name.
    pub(super) fn finish(&mut self) -> Result<()> {
        let failed = |error| Error::output(&self.target, format!("cannot be written: {error}"));
        fs::remove_dir_all(&self.work).map_err(failed)?;
        if self.replaces {
            fs::remove_dir_all(&self.target).map_err(failed)?;
        }
        self.lock.remove_file();
        // The rename replaces an empty folder.
        fs::rename(&self.folder, &self.target).map_err(failed)?;
        self.stays = true;
        // The log of an earlier attempt.
        let _ = fs::remove_file(self.kept_log());
        Ok(())
    }
}

/// Name of the log in the dataset.
const LOG: &str = "colmap.log";
/// The file with the origin of the cameras, in the dataset.
const ORIGIN: &str = "pose.txt";
/// The folder of what COLMAP has found so far.
const WORK: &str = "work";

/// The origin that a dataset of this module records.
pub(super) fn origin_of(dataset: &Path) -> Option<String> {
    fs::read_to_string(dataset.join(ORIGIN)).ok()
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        if !self.stays {
            // The cause is reported elsewhere; errors of the cleanup are not.
            let _ = fs::rename(&self.log, self.kept_log());
            let _ = fs::remove_dir_all(&self.folder);
        }
    }
}
