//! Camera poses of dark photographs: COLMAP runs on brightened copies of them.
//!
//! In: a folder of photographs, an archive of them, or a clip. Out: a dataset of the original photographs with the
//! cameras that COLMAP found.

mod cameras;
mod clip;
mod pictures;
mod reconstruction;
mod stages;
mod tone_mapped;
mod tool;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

pub use self::cameras::describe;
pub use self::reconstruction::{Mapper, Matcher};
pub use self::tool::how_to_install;

use self::pictures::{BRIGHT, Pictures, bright_name, is_dark};
use self::reconstruction::Reconstruction;
use self::tool::Tool;
use super::dataset::{Dataset, is_mask};
use super::image::files::{photographs_in, stem, unread_in};
use crate::base::output::{check_writable, create_folder, is_same_file, write_whole};
use crate::base::{input, tree};
use crate::camera::Lens;
use crate::gpu::{DeviceChoice, Gpu};
use crate::{Error, Result};

/// The photographs, the dataset to write, and the programs to run.
#[derive(Clone, Debug)]
pub struct PoseOptions {
    /// Folder or archive of photographs of one scene, or a clip.
    pub photos: PathBuf,
    /// Folder or archive of bright photographs of the same scene, through which the dark ones are posed.
    pub with: Option<PathBuf>,
    /// Dataset to write; it appears when complete.
    pub out: PathBuf,
    /// Replace a dataset that this module wrote.
    pub overwrite: bool,
    /// Path of COLMAP.
    pub colmap: PathBuf,
    /// Path of GLOMAP, for [`Mapper::Global`] with COLMAP before 4.0.
    pub glomap: PathBuf,
    /// Path of ffmpeg, for clips.
    pub ffmpeg: PathBuf,
    /// By default sequential for a clip, else exhaustive.
    pub matcher: Option<Matcher>,
    /// The mapper that registers cameras.
    pub mapper: Mapper,
    /// COLMAP options, each `NAME=VALUE`.
    pub colmap_options: Vec<String>,
    /// COLMAP camera model.
    pub camera_model: String,
    /// Whether COLMAP may use the GPU.
    pub colmap_gpu: bool,
    /// Frames per second to take of a clip, above 0 and at most 240.
    pub fps: f64,
    /// Device that brightens the photographs.
    pub device: DeviceChoice,
    /// How it is opened.
    pub open: fn(&DeviceChoice) -> Result<Gpu>,
}

/// Progress of [`estimate`].
#[derive(Clone, Copy, Debug)]
pub enum Progress<'a> {
    /// A line about a finished or running stage.
    Line(&'a str),
    /// Photographs done in the current pass over them.
    Photographs {
        /// Done so far.
        done: usize,
        /// In all.
        all: usize,
    },
}

/// The result of [`estimate`].
#[derive(Clone, Debug)]
pub struct Posed {
    /// Photographs given to COLMAP.
    pub photographs: usize,
    /// Photographs with a camera.
    pub placed: usize,
    /// Of the bright photographs, those with a camera and all; `None` without any.
    pub bright: Option<[usize; 2]>,
    /// The calibrated lenses.
    pub lenses: Vec<Lens>,
}

/// Fewer photographs than this have no reconstruction.
const MIN_CAMERAS: usize = 3;

/// Estimates the cameras and writes the dataset.
///
/// # Errors
/// [`Error::Usage`] if an option is invalid or a program is missing, [`Error::Input`] if the photographs are unusable
/// or a program fails or finds too few cameras, [`Error::Output`] if the dataset exists or cannot be written.
pub fn estimate(options: &PoseOptions, report: &dyn Fn(Progress<'_>)) -> Result<Posed> {
    if !(options.fps > 0.0 && options.fps <= 240.0) {
        let problem = format!("--fps is {}; it must be above 0 and at most 240", options.fps);
        return Err(Error::Usage(problem));
    }
    let is_clip = tree::is_file(&options.photos) && !tree::is_dir(&options.photos);
    check_writable(&options.out)?;
    let mut out = Unfinished::new(&options.out, options.overwrite)?;
    let colmap = Tool::new(&options.colmap, "colmap", &out.log)
        .found(&format!("by hand: {}", by_hand(&options.photos, &options.out)))?;
    let follows = is_clip && options.with.is_none();
    let matcher =
        options.matcher.unwrap_or(if follows { Matcher::Sequential } else { Matcher::Exhaustive });
    if options.with.is_some() && matcher == Matcher::Sequential {
        let problem = "--matcher sequential pairs neighbours by name, and no dark photograph with one of --with; take \
                       exhaustive";
        return Err(Error::Usage(problem.to_owned()));
    }
    let reconstruction = Reconstruction::new(options, colmap, matcher, &out.work)?;
    let folder = folder_of(&options.photos)?;
    let bright = options.with.as_deref().map(|with| bright_photographs(with, &folder));
    let bright = bright.transpose()?.unwrap_or_default();
    let dark = if is_clip {
        let ffmpeg = Tool::new(&options.ffmpeg, "ffmpeg", &out.log).found("")?;
        clip::frames(&ffmpeg, &options.photos, options.fps, &out.work.join("frames"))?
    } else {
        distinct_photographs(&folder)?
    };
    let gpu = (options.open)(&options.device)?;
    let mut pictures = Pictures { dark, bright, copies: out.work.join("tone-mapped") };
    let gain = tone_mapped::write(&gpu, &mut pictures.dark, &pictures.copies, report)?;
    let all = pictures.dark.len();
    report(Progress::Line(&format!("{all} photographs brightened (gain {gain:.1})")));
    if options.with.is_some() {
        // By a curve of their own, which leaves those in normal light as they are.
        let folder = pictures.copies.join(BRIGHT);
        let gain = tone_mapped::write(&gpu, &mut pictures.bright, &folder, report)?;
        let count = pictures.bright.len();
        report(Progress::Line(&format!("{count} bright photographs beside them (gain {gain:.1})")));
    }
    let models = reconstruction.models(&pictures, report)?;
    let largest = Dataset::largest_model(&models, is_dark)?;
    let has_enough = |(_, names): &(PathBuf, Vec<String>)| {
        names.len() >= MIN_CAMERAS && names.iter().any(|name| is_dark(name))
    };
    let (model, names) = largest.filter(has_enough).ok_or_else(|| {
        let problem = format!(
            "COLMAP found no cameras for these {all} photographs: too little overlap or texture; take more \
             photographs, closer together, or expose longer ({} has its output)",
            out.kept_log().display()
        );
        Error::input(&options.photos, problem)
    })?;
    let bright: Vec<String> = names.iter().filter_map(|name| bright_name(name)).collect();
    let dark: Vec<String> = names.into_iter().filter(|name| is_dark(name)).collect();
    out.add_photographs("", &pictures.dark, &dark)?;
    out.add_masks(&folder, is_clip)?;
    let own_name = |name: &str| is_dark(name).then(|| name.to_owned());
    let sparse = out.add_model("", &model, options.with.as_ref().map(|_| own_name))?;
    if !bright.is_empty() {
        out.add_photographs(BRIGHT, &pictures.bright, &bright)?;
        out.add_model(BRIGHT, &model, Some(bright_name))?;
    }
    let lenses = Dataset::lenses(&sparse)?;
    out.finish()?;
    let placed = dark.len();
    let target = options.out.display();
    report(Progress::Line(&format!("{placed} of {all} photographs have a camera -> {target}")));
    warn_of_unplaced(&pictures.dark, &dark);
    for lens in &lenses {
        if let Some(problem) = cameras::implausible(lens) {
            tracing::warn!(
                "the calibration of {} is implausible: {problem}; photographs of several lenses may \
                 share it, or overlap too little",
                describe(lens)
            );
        }
    }
    if 2 * placed < all {
        tracing::warn!(
            "most photographs have no camera; take more of them, closer together, or expose longer"
        );
    }
    let bright = options.with.as_ref().map(|_| [bright.len(), pictures.bright.len()]);
    Ok(Posed { photographs: all, placed, bright, lenses })
}

/// Names the first photographs without a camera.
fn warn_of_unplaced(photographs: &[PathBuf], placed: &[String]) {
    const NAMED: usize = 5;
    let placed: BTreeSet<&str> = placed.iter().map(|name| stem(name)).collect();
    let names = photographs.iter().filter_map(|path| path.file_name()?.to_str());
    let without: Vec<&str> = names.filter(|name| !placed.contains(stem(name))).collect();
    if !without.is_empty() {
        let (count, first) = (without.len(), without[..without.len().min(NAMED)].join(", "));
        let more = if count > NAMED { ", ..." } else { "" };
        tracing::warn!("{count} photographs have no camera and are left out: {first}{more}");
    }
}

/// The folder of photographs, which may be in an archive.
fn folder_of(photos: &Path) -> Result<PathBuf> {
    match tree::archive_of(photos) {
        Some(_) => Dataset::folder_of(photos),
        None => Ok(photos.to_owned()),
    }
}

/// The bright photographs, which are not in the folder of the dark ones.
///
/// # Errors
/// Those of [`distinct_photographs`], or both are in one folder.
fn bright_photographs(with: &Path, dark: &Path) -> Result<Vec<PathBuf>> {
    let bright = folder_of(with)?;
    if is_same_file(&bright, dark) {
        let problem = "is the folder of the dark photographs itself; --with takes the bright ones";
        return Err(Error::input(with, problem));
    }
    distinct_photographs(&bright)
}

/// The commands to run COLMAP by hand.
fn by_hand(photos: &Path, out: &Path) -> String {
    let (photos, out) = (photos.display(), out.display());
    format!(
        "nightsplat tone apply {photos} --scene-statistics --out bright && mkdir -p {out}/sparse && colmap \
         feature_extractor --database_path {out}/database.db --image_path bright --ImageReader.single_camera 1 \
         && colmap exhaustive_matcher --database_path {out}/database.db && colmap mapper --database_path \
         {out}/database.db --image_path bright --output_path {out}/sparse && cp -r {photos} {out}/images"
    )
}

/// The photographs of a folder.
///
/// # Errors
/// [`Error::Input`] if there are too few, or two differ in their extension alone: COLMAP sees both as one PNG.
fn distinct_photographs(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut paths = photographs_in(folder)?;
    paths.retain(|path| !is_mask(path));
    if let Some(line) = unread_in(folder) {
        tracing::warn!("{line}");
    }
    if paths.len() < MIN_CAMERAS {
        let problem = format!(
            "contains {} photographs (PNG, JPEG, WebP, TIFF or EXR); at least {MIN_CAMERAS} are needed",
            paths.len()
        );
        return Err(Error::input(folder, problem));
    }
    let mut seen = BTreeMap::new();
    for path in &paths {
        let own = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if let Some(other) = seen.insert(stem(&own).to_owned(), own.clone()) {
            let problem = format!("{other} and {own} have the same name; rename one");
            return Err(Error::input(folder, problem));
        }
    }
    Ok(paths)
}

/// Creates a hard link in `folder`, or a copy if the file system has no links.
fn link_or_copy(from: &Path, folder: &Path) -> Result<()> {
    let to = folder.join(from.file_name().unwrap_or_default());
    if tree::archive_of(from).is_some() {
        return write_whole(&to, &input::bytes(from)?);
    }
    let from = from.canonicalize().unwrap_or_else(|_| from.to_owned());
    if fs::hard_link(&from, &to).is_ok() {
        return Ok(());
    }
    fs::copy(&from, &to)
        .map(drop)
        .map_err(|error| Error::output(&to, format!("cannot be written: {error}")))
}

/// A dataset under a temporary name, removed unless it is finished.
struct Unfinished {
    target: PathBuf,
    replaces: bool,
    /// The folder that becomes the dataset.
    folder: PathBuf,
    /// Working folder of COLMAP.
    work: PathBuf,
    /// Output of the programs.
    log: PathBuf,
    is_finished: bool,
}

impl Unfinished {
    fn new(target: &Path, overwrite: bool) -> Result<Self> {
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
    fn add_photographs(
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
    fn add_masks(&self, source: &Path, is_clip: bool) -> Result<()> {
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

    /// Adds the files of a COLMAP model to the dataset `below` this one; where names are given anew, with the images
    /// that have one. Returns their folder.
    fn add_model(
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
        match renamed {
            None => link_or_copy(&model.join("images.bin"), &sparse)?,
            Some(renamed) => {
                let images = Dataset::images_renamed(model, renamed)?;
                write_whole(&sparse.join("images.bin"), &images)?;
            }
        }
        Ok(sparse)
    }

    /// Where the log of a failed attempt is kept.
    fn kept_log(&self) -> PathBuf {
        let mut path = self.target.as_os_str().to_owned();
        path.push(".");
        path.push(LOG);
        path.into()
    }

    /// Gives the dataset its name.
    fn finish(&mut self) -> Result<()> {
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
