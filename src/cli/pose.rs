//! `nightsplat pose`: from photographs without cameras to a dataset.

mod clip;
mod reconstruction;
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
use crate::Error;
use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::Dataset;
use crate::photographs::image::files::{photographs_in, stem, unread_in};

/// Find the cameras of dark photographs with COLMAP, and write a dataset that `train` takes.
///
/// COLMAP finds next to nothing in the dark. This lifts the photographs first, all by one curve
/// so that what matches stays alike, lets your `colmap` find the cameras in the lifted ones, and
/// writes a dataset of the dark photographs with these cameras:
///
///   nightsplat pose photos --out scene
///   nightsplat train scene --out run
///
/// The focal length that a JPEG's Exif names is where COLMAP begins. A clip goes through your
/// `ffmpeg` first: of each window of 1 / --fps seconds the sharpest frame is taken.
#[derive(Clone, Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub struct PoseArgs {
    /// A folder of photographs of one scene, or a clip (.mp4, .mov, .mkv)
    pub photos: PathBuf,
    /// The dataset to write; it appears once it is whole
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// The program `colmap`
    #[arg(long, value_name = "PATH", default_value = "colmap")]
    pub colmap: PathBuf,
    /// Which photographs are compared: each with each, or with those that follow it by name [default: sequential for a clip, else exhaustive]
    #[arg(long, value_enum)]
    pub matcher: Option<Matcher>,
    /// How cameras are placed: one after the other, or all at once, which many photographs are faster by
    #[arg(long, value_enum, default_value_t = Mapper::Incremental)]
    pub mapper: Mapper,
    /// The program `glomap`, which places all at once where your COLMAP is older than 4.0
    #[arg(long, value_name = "PATH", default_value = "glomap")]
    pub glomap: PathBuf,
    /// COLMAP's model of the lens, the same for all photographs of one size
    #[arg(long, value_name = "NAME", default_value = "OPENCV")]
    pub camera_model: String,
    /// How many frames a second of a clip to take
    #[arg(long, value_name = "F", default_value_t = 2.0)]
    pub fps: f64,
    /// The program `ffmpeg`, for clips
    #[arg(long, value_name = "PATH", default_value = "ffmpeg")]
    pub ffmpeg: PathBuf,
    /// Let COLMAP compute features on the GPU; it needs a display or CUDA for that
    #[arg(long)]
    pub colmap_gpu: bool,
    /// Replace a dataset that `pose` wrote before
    #[arg(long)]
    pub overwrite: bool,
    /// The device that lifts: uuid:, pci: or index of `nightsplat doctor`, a part of its name, or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// Two cameras tell the shape of little.
const FEWEST: usize = 3;

/// Finds the cameras and writes the dataset.
///
/// # Errors
/// A program is missing, fails or finds too few cameras; the photographs are not usable; the dataset exists.
pub fn run(args: &PoseArgs) -> Result<()> {
    if !(args.fps > 0.0 && args.fps <= 240.0) {
        return Err(Error::Usage(format!(
            "--fps is {}; it must be above 0 and at most 240",
            args.fps
        ))
        .into());
    }
    let is_clip = args.photos.is_file();
    let begin = Instant::now();
    let mut out = Unfinished::new(&args.out, args.overwrite)?;
    let colmap = Tool::new(&args.colmap, "colmap", &out.log)
        .found(&format!("by hand: {}", by_hand(&args.photos, &args.out)))?;
    let matcher =
        args.matcher.unwrap_or(if is_clip { Matcher::Sequential } else { Matcher::Exhaustive });
    let reconstruction = Reconstruction::new(args, colmap, matcher, &out.work)?;
    let photographs = if is_clip {
        let ffmpeg = Tool::new(&args.ffmpeg, "ffmpeg", &out.log).found("")?;
        clip::frames(&ffmpeg, &args.photos, args.fps, &out.work.join("frames"))?
    } else {
        photographs(&args.photos)?
    };
    let gpu = Gpu::new(&args.device.clone().unwrap_or_default())?;
    let tone_mapped = out.work.join("tone-mapped");
    let gain = tone_mapped::write(&gpu, &photographs, &tone_mapped)?;
    say(begin, &format!("{} photographs lifted (gain {gain:.1})", photographs.len()))?;
    let models = reconstruction.models(&tone_mapped, |what| say(begin, what))?;
    let (model, placed) = Dataset::largest_model(&models)?.filter(|(_, placed)| placed.len() >= FEWEST).ok_or_else(|| {
        let problem = format!(
            "COLMAP found no cameras for these {} photographs: they show too little in common or no texture; take more of them, closer together, or expose longer ({} has its output)",
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
    create(&images)?;
    for name in &placed {
        let Some(path) = by_name.get(stem(name)) else { continue };
        link_or_copy(path, &images.join(path.file_name().unwrap_or_default()))?;
    }
    keep_masks(&args.photos.join("masks"), &out.folder.join("masks"))?;
    let sparse = out.folder.join("sparse/0");
    create(&sparse)?;
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        link_or_copy(&model.join(file), &sparse.join(file))?;
    }
    out.finish()?;
    let (count, of) = (placed.len(), photographs.len());
    say(begin, &format!("{count} of {of} photographs have a camera -> {}", args.out.display()))?;
    if 2 * count < of {
        tracing::warn!(
            "most photographs have no camera: take more of them, closer together, or expose longer"
        );
    }
    writeln!(
        std::io::stdout(),
        "{}: {count} of {of} photographs with their cameras; next: nightsplat train {} --out run",
        args.out.display(),
        args.out.display()
    )?;
    Ok(())
}

/// What to type where nightsplat cannot.
fn by_hand(photos: &Path, out: &Path) -> String {
    let (photos, out) = (photos.display(), out.display());
    format!(
        "nightsplat tone apply {photos} --scene-statistics --out lifted && mkdir -p {out}/sparse && \
         colmap feature_extractor --database_path {out}/database.db --image_path lifted --ImageReader.single_camera 1 && \
         colmap exhaustive_matcher --database_path {out}/database.db && \
         colmap mapper --database_path {out}/database.db --image_path lifted --output_path {out}/sparse && \
         cp -r {photos} {out}/images"
    )
}

/// The masks beside the photographs go with them.
fn keep_masks(masks: &Path, to: &Path) -> Result<()> {
    if !masks.is_dir() {
        return Ok(());
    }
    create(to)?;
    for mask in photographs_in(masks)? {
        link_or_copy(&mask, &to.join(mask.file_name().unwrap_or_default()))?;
    }
    Ok(())
}

/// The photographs of a folder, of different names.
fn photographs(folder: &Path) -> Result<Vec<PathBuf>> {
    let paths = photographs_in(folder)?;
    if let Some(line) = unread_in(folder) {
        tracing::warn!("{line}");
    }
    if paths.len() < FEWEST {
        let problem = format!(
            "holds {} photographs, at least {FEWEST} are needed; name the folder that holds them (PNG, JPEG, WebP, TIFF or EXR)",
            paths.len()
        );
        return Err(Error::input(folder, problem).into());
    }
    let mut seen = BTreeMap::new();
    for path in &paths {
        let own = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if let Some(other) = seen.insert(stem(&own).to_owned(), own.clone()) {
            let problem = format!("{other} and {own} are two photographs of one name; rename one");
            return Err(Error::input(folder, problem).into());
        }
    }
    Ok(paths)
}

fn say(begin: Instant, what: &str) -> Result<()> {
    writeln!(std::io::stderr(), "{:5.0} s  {what}", begin.elapsed().as_secs_f64())?;
    Ok(())
}

fn create(folder: &Path) -> crate::Result<()> {
    fs::create_dir_all(folder)
        .map_err(|error| Error::output(folder, format!("cannot be made: {error}")))
}

/// The same file under another name where the disk can do that, else a copy.
fn link_or_copy(from: &Path, to: &Path) -> crate::Result<()> {
    let from = from.canonicalize().unwrap_or_else(|_| from.to_owned());
    if fs::hard_link(&from, to).is_ok() {
        return Ok(());
    }
    fs::copy(&from, to)
        .map(drop)
        .map_err(|error| Error::output(to, format!("cannot be written: {error}")))
}

/// A dataset that is being made under another name, and goes where it is not finished.
struct Unfinished {
    target: PathBuf,
    replaces: bool,
    /// What becomes the dataset.
    folder: PathBuf,
    /// What COLMAP works in.
    work: PathBuf,
    /// What the programs say.
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
            let problem =
                "is what an interrupted `nightsplat pose` left, or one at work; remove it";
            return Err(Error::output(folder, problem));
        }
        let work = folder.join("work");
        create(&work)?;
        let log = folder.join(LOG);
        let replaces = holds(target);
        Ok(Self { target: target.to_owned(), replaces, folder, work, log, is_finished: false })
    }

    /// Where the log stays of what fails.
    fn kept_log(&self) -> PathBuf {
        let mut path = self.target.as_os_str().to_owned();
        path.push(".");
        path.push(LOG);
        path.into()
    }

    /// The dataset under its own name.
    fn finish(&mut self) -> crate::Result<()> {
        let failed = |error| Error::output(&self.target, format!("cannot be written: {error}"));
        fs::remove_dir_all(&self.work).map_err(failed)?;
        if self.replaces {
            fs::remove_dir_all(&self.target).map_err(failed)?;
        }
        // An empty folder may stand there; a rename replaces it.
        fs::rename(&self.folder, &self.target).map_err(failed)?;
        self.is_finished = true;
        // That of an attempt before.
        let _ = fs::remove_file(self.kept_log());
        Ok(())
    }
}

/// The output of the programs, in the dataset.
const LOG: &str = "colmap.log";

impl Drop for Unfinished {
    fn drop(&mut self) {
        if !self.is_finished {
            // What failed is reported; a leftover of it is not.
            let _ = fs::rename(&self.log, self.kept_log());
            let _ = fs::remove_dir_all(&self.folder);
        }
    }
}
