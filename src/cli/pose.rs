//! `nightsplat pose`: estimates the cameras of photographs with COLMAP.

mod cameras;
mod clip;
mod reconstruction;
mod stages;
mod tone_mapped;
mod tool;

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Result;

use self::reconstruction::{Mapper, Matcher, Reconstruction};
use self::tool::Tool;
pub(super) use self::tool::sources;
use super::{finish, word};
use crate::Error;
use crate::base::output::{check_writable, create_folder, write_whole};
use crate::base::{input, tree};
use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::{Dataset, is_mask};
use crate::photographs::image::files::{photographs_in, stem, unread_in};

/// Estimate the cameras of dark photographs with COLMAP, and write a dataset for `train`.
///
/// COLMAP finds few features in dark photographs. This command brightens them first, all by the same curve, runs your
/// `colmap` on the result, and writes a dataset of the original photographs with the cameras that it found. The focal
/// length in a JPEG's Exif is the initial value. Frames of a clip are extracted with your `ffmpeg`: the sharpest of
/// each 1 / --fps seconds.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = EXAMPLE)]
pub struct PoseArgs {
    /// Folder of photographs of one scene, or a clip (.mp4, .mov, .mkv)
    pub photos: PathBuf,
    /// Dataset to write; it appears when complete
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Path of COLMAP
    #[arg(long, value_name = "PATH", default_value = "colmap")]
    pub colmap: PathBuf,
    /// Match every pair, or neighbours by name [default: sequential for a clip, else exhaustive]
    #[arg(long, value_enum)]
    pub matcher: Option<Matcher>,
    /// Register cameras one by one, or all at once, which is faster for many photographs
    #[arg(long, value_enum, default_value_t = Mapper::Incremental)]
    pub mapper: Mapper,
    /// Path of GLOMAP, for --mapper global with COLMAP before 4.0
    #[arg(long, value_name = "PATH", default_value = "glomap")]
    pub glomap: PathBuf,
    /// Option of a COLMAP command, as `Mapper.init_min_tri_angle=4`; may be given again
    #[arg(long, value_name = "NAME=VALUE")]
    pub colmap_option: Vec<String>,
    /// COLMAP camera model; photographs of one size, lens and focal length share a camera
    #[arg(long, value_name = "NAME", default_value = "OPENCV")]
    pub camera_model: String,
    /// Frames per second to take of a clip
    #[arg(long, value_name = "F", default_value_t = 2.0)]
    pub fps: f64,
    /// Path of ffmpeg, for clips
    #[arg(long, value_name = "PATH", default_value = "ffmpeg")]
    pub ffmpeg: PathBuf,
    /// Let COLMAP use the GPU, which takes a display or CUDA
    #[arg(long)]
    pub colmap_gpu: bool,
    /// Replace a dataset that `pose` wrote
    #[arg(long)]
    pub overwrite: bool,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// The calibrations that are shown, at most.
const MOST_SHOWN: usize = 3;

/// Fewer cameras constrain no shape.
const FEWEST: usize = 3;

const EXAMPLE: &str = "Example:
  nightsplat pose photos --out scene
  nightsplat train scene --out run";

/// Estimates the cameras and writes the dataset.
///
/// # Errors
/// A program is missing, fails or finds too few cameras; the photographs are unusable; the dataset exists.
pub fn run(args: &PoseArgs) -> Result<()> {
    if !(args.fps > 0.0 && args.fps <= 240.0) {
        return Err(Error::Usage(format!(
            "--fps is {}; it must be above 0 and at most 240",
            args.fps
        ))
        .into());
    }
    let is_clip = tree::is_file(&args.photos) && !tree::is_dir(&args.photos);
    let begin = Instant::now();
    check_writable(&args.out)?;
    let mut out = Unfinished::new(&args.out, args.overwrite)?;
    let colmap = Tool::new(&args.colmap, "colmap", &out.log)
        .found(&format!("by hand: {}", by_hand(&args.photos, &args.out)))?;
    let matcher =
        args.matcher.unwrap_or(if is_clip { Matcher::Sequential } else { Matcher::Exhaustive });
    let reconstruction = Reconstruction::new(args, colmap, matcher, &out.work)?;
    let folder = if tree::archive_of(&args.photos).is_some() {
        Dataset::folder_of(&args.photos)?
    } else {
        args.photos.clone()
    };
    let mut photographs = if is_clip {
        let ffmpeg = Tool::new(&args.ffmpeg, "ffmpeg", &out.log).found("")?;
        clip::frames(&ffmpeg, &args.photos, args.fps, &out.work.join("frames"))?
    } else {
        photographs(&folder)?
    };
    let gpu = Gpu::new(&args.device.clone().unwrap_or_default())?;
    let tone_mapped = out.work.join("tone-mapped");
    let gain = tone_mapped::write(&gpu, &mut photographs, &tone_mapped)?;
    say(begin, &format!("{} photographs brightened (gain {gain:.1})", photographs.len()))?;
    let models = reconstruction.models((&tone_mapped, &photographs), |what| say(begin, what))?;
    let (model, placed) = Dataset::largest_model(&models)?.filter(|(_, placed)| placed.len() >= FEWEST).ok_or_else(|| {
        let problem = format!(
            "COLMAP found no cameras for these {} photographs: too little overlap or texture; take more \
             photographs, closer together, or expose longer ({} has its output)",
            photographs.len(),
            out.kept_log().display()
        );
        Error::input(&args.photos, problem)
    })?;
    let by_name: BTreeMap<&str, &PathBuf> = photographs
        .iter()
        .filter_map(|path| Some((stem(path.file_name()?.to_str()?), path)))
        .collect();
    let images = out.folder.join("images");
    create_folder(&images)?;
    for name in &placed {
        let Some(path) = by_name.get(stem(name)) else { continue };
        link_or_copy(path, &images.join(path.file_name().unwrap_or_default()))?;
    }
    keep_masks(&folder.join("masks"), &out.folder.join("masks"))?;
    if !is_clip {
        for mask in photographs_in(&folder)?.iter().filter(|file| is_mask(file)) {
            link_or_copy(mask, &images.join(mask.file_name().unwrap_or_default()))?;
        }
    }
    let sparse = out.folder.join("sparse/0");
    create_folder(&sparse)?;
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        link_or_copy(&model.join(file), &sparse.join(file))?;
    }
    let lenses = Dataset::lenses(&sparse)?;
    out.finish()?;
    let (count, of) = (placed.len(), photographs.len());
    say(begin, &format!("{count} of {of} photographs have a camera -> {}", args.out.display()))?;
    for lens in &lenses {
        if let Some(problem) = cameras::implausible(lens) {
            tracing::warn!(
                "the calibration of {} is implausible: {problem}; photographs of several lenses may \
                 share it, or overlap too little",
                cameras::shown(lens)
            );
        }
    }
    if 2 * count < of {
        tracing::warn!(
            "most photographs have no camera; take more of them, closer together, or expose longer"
        );
    }
    let wrote = format!(
        "{}: {count} of {of} photographs with their cameras, {} calibrated ({})",
        args.out.display(),
        if lenses.len() == 1 { "one".to_owned() } else { lenses.len().to_string() },
        lenses.iter().take(MOST_SHOWN).map(cameras::shown).collect::<Vec<_>>().join("; ")
    );
    finish(&wrote, &format!("nightsplat train {} --out run", word(&args.out)))
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

/// Links the masks into the dataset.
fn keep_masks(masks: &Path, to: &Path) -> Result<()> {
    if !masks.is_dir() {
        return Ok(());
    }
    create_folder(to)?;
    for mask in photographs_in(masks)? {
        link_or_copy(&mask, &to.join(mask.file_name().unwrap_or_default()))?;
    }
    Ok(())
}

/// The photographs of a folder; their names differ.
fn photographs(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut paths = photographs_in(folder)?;
    paths.retain(|path| !is_mask(path));
    if let Some(line) = unread_in(folder) {
        tracing::warn!("{line}");
    }
    if paths.len() < FEWEST {
        let problem = format!(
            "contains {} photographs (PNG, JPEG, WebP, TIFF or EXR); at least {FEWEST} are needed",
            paths.len()
        );
        return Err(Error::input(folder, problem).into());
    }
    let mut seen = BTreeMap::new();
    for path in &paths {
        let own = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if let Some(other) = seen.insert(stem(&own).to_owned(), own.clone()) {
            let problem = format!("{other} and {own} have the same name; rename one");
            return Err(Error::input(folder, problem).into());
        }
    }
    Ok(paths)
}

fn say(begin: Instant, what: &str) -> Result<()> {
    writeln!(std::io::stderr(), "{:5.0} s  {what}", begin.elapsed().as_secs_f64())?;
    Ok(())
}

/// Creates a hard link, or a copy where the file system has no links.
fn link_or_copy(from: &Path, to: &Path) -> crate::Result<()> {
    if tree::archive_of(from).is_some() {
        return write_whole(to, &input::bytes(from)?);
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
    fn new(target: &Path, overwrite: bool) -> crate::Result<Self> {
        let mut folder = target.as_os_str().to_owned();
        folder.push(".partial");
        let folder = PathBuf::from(folder);
        let holds =
            |folder: &Path| fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_some());
        let is_ours = target.join(LOG).is_file();
        if target.is_file() || (holds(target) && !(overwrite && is_ours)) {
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
        let replaces = holds(target);
        Ok(Self { target: target.to_owned(), replaces, folder, work, log, is_finished: false })
    }

    /// The log of a failed attempt.
    fn kept_log(&self) -> PathBuf {
        let mut path = self.target.as_os_str().to_owned();
        path.push(".");
        path.push(LOG);
        path.into()
    }

    /// Gives the dataset its name.
    fn finish(&mut self) -> crate::Result<()> {
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
