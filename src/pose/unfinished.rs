//! The dataset while it is written.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use nightsplat_core::output::{create_folder, write_whole};
use nightsplat_photographs::dataset::{Dataset, is_mask, mask_beside};
use nightsplat_photographs::image::files::{PhotographFiles, photographs_in, stem};
use nightsplat_photographs::tree;

use super::pictures::PosePhotographs;
use crate::{Error, Result};

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
    if fs::hard_link(&from, to).is_ok() {
        return Ok(());
    }
    fs::copy(&from, to)
        .map(drop)
        .map_err(|error| Error::output(to, format!("cannot be written: {error}")))
}

/// A dataset under a temporary name, removed unless it is finished.
pub(super) struct Unfinished {
    target: PathBuf,
    replaces: bool,
    /// The folder that becomes the dataset.
    folder: PathBuf,
    /// Working folder of COLMAP.
    pub(super) work: PathBuf,
    /// Output of the programs.
    pub(super) log: PathBuf,
    is_finished: bool,
}

impl Unfinished {
    pub(super) fn new(target: &Path, overwrite: bool) -> Result<Self> {
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
        if folder.exists() {
            let problem = "belongs to an interrupted or running `nightsplat pose`; remove it";
            return Err(Error::output(folder, problem));
        }
        let work = folder.join("work");
        create_folder(&work)?;
        let log = folder.join(LOG);
        let replaces = has_files(target);
        Ok(Self { target: target.to_owned(), replaces, folder, work, log, is_finished: false })
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
        // The rename replaces an empty folder.
        fs::rename(&self.folder, &self.target).map_err(failed)?;
        self.is_finished = true;
        // The log of an earlier attempt.
        let _ = fs::remove_file(self.kept_log());
        Ok(())
    }
}

/// Name of the log in the dataset.
const LOG: &str = "colmap.log";

impl Drop for Unfinished {
    fn drop(&mut self) {
        if !self.is_finished {
            // The cause is reported elsewhere; errors of the cleanup are not.
            let _ = fs::rename(&self.log, self.kept_log());
            let _ = fs::remove_dir_all(&self.folder);
        }
    }
}
