//! Camera poses of dark photographs: COLMAP runs on brightened copies of them.
//!
//! In: a folder of photographs, an archive of them, or a clip. Out: a dataset of the original photographs with the
//! cameras that COLMAP found. The photographs are brightened by a function of the caller, which has a device.

mod cameras;
mod clip;
mod expected;
mod in_place;
mod motion;
mod origin;
mod pictures;
mod reconstruction;
mod stages;
mod tone_mapped;
mod tool;
mod unfinished;

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

use nightsplat_core::camera::Lens;
use nightsplat_core::output::{about, is_same_file};
use nightsplat_core::{Error, Result, Stop};
use nightsplat_photographs::dataset::{Dataset, is_mask};
use nightsplat_photographs::image::StoredLight;
use nightsplat_photographs::image::files::{photographs_in, stem, unread_in};
use nightsplat_photographs::tree;
use nightsplat_photographs::tree::check_writable;

use self::cameras::WeakCameras;
pub use self::cameras::describe;
use self::pictures::{BRIGHT, PosePhotographs, bright_name, is_dark};
use self::reconstruction::Reconstruction;
pub use self::reconstruction::{Mapper, Matcher, PoseFeatures};
pub use self::tone_mapped::ToneMapper;
use self::tool::Tool;
pub use self::tool::how_to_install;
use self::unfinished::Unfinished;

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
    /// Further attempts, where few photographs have a camera, take this many times the time of the first at most.
    pub patience: f64,
    /// By default sequential for a clip, else exhaustive.
    pub matcher: Option<Matcher>,
    /// By default SIFT, then learned ones where few photographs have a camera and this COLMAP has them.
    pub features: Option<PoseFeatures>,
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
    /// How integer files of the dark photographs store light.
    pub light: Option<StoredLight>,
}

/// Who follows [`estimate`].
#[expect(missing_debug_implementations, reason = "closures have none")]
#[derive(Clone, Copy)]
pub struct PoseWatch<'a> {
    /// Takes the progress.
    pub report: &'a dyn Fn(PoseProgress<'_>),
    /// Why the work is to stop, if it is.
    pub stops: &'a dyn Fn() -> Option<Stop>,
}

/// Progress of [`estimate`].
#[derive(Clone, Copy, Debug)]
pub enum PoseProgress<'a> {
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

/// The folder of the tone-mapped copies, and the mark that they are whole.
const BRIGHTENED: &str = "tone-mapped";

/// Fewer photographs than this have no reconstruction.
const MIN_CAMERAS: usize = 3;

/// Estimates the cameras and writes the dataset; `open` gives what brightens the photographs. A call that was stopped
/// or killed is gone on with by the next one of the same photographs and options.
///
/// # Errors
/// The photographs or programs cannot be used, few have a camera, or the work is stopped.
pub fn estimate(
    options: &PoseOptions,
    open: &dyn Fn() -> Result<ToneMapper>,
    watch: &PoseWatch<'_>,
) -> Result<Posed> {
    if !(options.fps > 0.0 && options.fps <= 240.0) {
        let problem = format!("--fps is {}; it must be above 0 and at most 240", options.fps);
        return Err(Error::Usage(problem));
    }
    if !(options.patience >= 0.0 && options.patience < 1e6) {
        let problem = format!("--patience is {}; it must be 0 or above", options.patience);
        return Err(Error::Usage(problem));
    }
    check_writable(&options.out)?;
    let mut out = Unfinished::open(&options.out, options.overwrite, &origin::line(options))?;
    let posed = posed(options, &mut out, open, watch);
    if posed.as_ref().is_err_and(Error::is_stop) {
        out.keep();
    }
    posed
}

/// Whether there are cameras at `out`, as [`estimate`] finds them with these options.
pub fn is_estimated(options: &PoseOptions) -> bool {
    unfinished::origin_of(&options.out).is_some_and(|of| of == origin::line(options))
}

/// Seconds that it takes to find cameras with these options, within a factor of two or three; `None` of a clip, whose
/// frames are not known.
pub fn expected(options: &PoseOptions) -> Option<f64> {
    let photographs = photographs_in(&options.photos).ok()?;
    let with = options.with.as_ref().and_then(|with| photographs_in(with).ok()).unwrap_or_default();
    let count = photographs.len() + with.len();
    let matcher = options.matcher.unwrap_or(Matcher::Exhaustive);
    let seconds = expected::seconds_of(count, photographs.first().map(PathBuf::as_path), matcher);
    Some(seconds.into_iter().sum())
}

fn posed(
    options: &PoseOptions,
    out: &mut Unfinished,
    open: &dyn Fn() -> Result<ToneMapper>,
    PoseWatch { report, stops }: &PoseWatch<'_>,
) -> Result<Posed> {
    let is_clip = tree::is_file(&options.photos) && !tree::is_dir(&options.photos);
    let colmap = Tool::new(&options.colmap, "colmap", out, stops).found()?;
    let matcher = matcher(options, is_clip)?;
    let reconstruction = Reconstruction::new(options, colmap, matcher, out)?;
    let folder = folder_of(&options.photos)?;
    let bright = options.with.as_deref().map(|with| bright_photographs(with, &folder));
    let bright = bright.transpose()?.unwrap_or_default();
    let dark = if is_clip {
        let (folder, done) = (out.work.join("frames"), out.seconds_of("frames").is_some());
        let frames = if done {
            photographs_in(&folder)?
        } else {
            let _ = std::fs::remove_dir_all(&folder);
            let ffmpeg = colmap.beside(&options.ffmpeg, "ffmpeg").found()?;
            clip::frames(&ffmpeg, &options.photos, options.fps, &folder)?
        };
        out.done("frames", 0.0)?;
        if let Some(remark) = motion::short_clip(&options.photos, frames.len(), options.fps) {
            tracing::warn!("{remark}");
        }
        frames
    } else {
        distinct_photographs(&folder)?
    };
    let [copies, masks] = [BRIGHTENED, "masks"].map(|name| out.work.join(name));
    let mut pictures = PosePhotographs { dark, bright, copies, masks };
    if out.seconds_of(BRIGHTENED).is_some() {
        pictures.retain_copied();
        report(PoseProgress::Line("going on where an earlier call was stopped"));
    } else {
        brighten(&open()?, &mut pictures, options.light, &|progress| {
            report(progress);
            stops().map_or(Ok(()), |cause| Err(out.stopped("brightening", cause)))
        })?;
        in_place::mask(&pictures)?;
        out.done(BRIGHTENED, 0.0)?;
    }
    let all = pictures.dark.len();
    let dark_copies: Vec<PathBuf> = pictures.dark.iter().map(|path| pictures.copy(path)).collect();
    if let Some(remark) = motion::at_rest(&dark_copies) {
        tracing::warn!("{remark}");
    }
    if options.features != Some(PoseFeatures::Learned) {
        let [features, matches, cameras] = expected::seconds(&pictures, matcher);
        report(PoseProgress::Line(&format!(
            "{} in all, coarsely: features {}, matching {}, cameras {}",
            about(features + matches + cameras),
            about(features),
            about(matches),
            about(cameras)
        )));
    }
    reconstruction.plan().into_iter().for_each(|plan| report(PoseProgress::Line(plan)));
    let models = reconstruction.models(&pictures, report)?;
    let found = best_model(&models)?.ok_or_else(|| {
        let problem = format!(
            "COLMAP found no cameras for these {all} photographs: too little overlap or texture; take more \
             photographs, closer together, or expose longer ({} has its output)",
            out.kept_log().display()
        );
        Error::input(&options.photos, problem)
    })?;
    let Found { model, dark, bright, weak } = found;
    let lenses = possible_lenses(&model, &options.photos)?;
    out.add_photographs("", &pictures.dark, &dark)?;
    out.add_masks(&folder, is_clip)?;
    out.add_masks_in_place("", &pictures, &pictures.dark, &dark)?;
    let kept: HashSet<&str> = dark.iter().map(String::as_str).collect();
    let own_name = |name: &str| kept.contains(name).then(|| name.to_owned());
    let is_part = options.with.is_some() || weak.is_some();
    out.add_model("", &model, is_part.then_some(own_name))?;
    if !bright.is_empty() {
        out.add_photographs(BRIGHT, &pictures.bright, &bright)?;
        out.add_masks_in_place(BRIGHT, &pictures, &pictures.bright, &bright)?;
        out.add_model(BRIGHT, &model, Some(bright_name))?;
    }
    out.finish()?;
    let placed = dark.len();
    let target = options.out.display();
    report(PoseProgress::Line(&format!("{placed} of {all} photographs have a camera -> {target}")));
    warn_of(&lenses, &pictures.dark, &dark, weak.as_ref());
    let bright = options.with.as_ref().map(|_| [bright.len(), pictures.bright.len()]);
    Ok(Posed { photographs: all, placed, bright, lenses })
}

/// The model with most of the dark photographs, and the photographs whose cameras are used.
struct Found {
    model: PathBuf,
    dark: Vec<String>,
    /// Names relative to the folder of the bright photographs.
    bright: Vec<String>,
    weak: Option<WeakCameras>,
}

/// The best of the models; `None` if none has enough cameras that can be used.
fn best_model(models: &Path) -> Result<Option<Found>> {
    let Some((model, names)) = Dataset::largest_model(models, is_dark)? else { return Ok(None) };
    let mut seen = Dataset::points_seen(&model)?;
    // Bright photographs see more points than dark ones do, which would make all of these weak.
    seen.retain(|(name, _)| is_dark(name));
    let weak = WeakCameras::find(&seen);
    let is_weak = |name: &String| weak.as_ref().is_some_and(|weak| weak.names.contains(name));
    let is_used = |name: &String| is_dark(name) && !is_weak(name);
    let bright: Vec<String> = names.iter().filter_map(|name| bright_name(name)).collect();
    let dark: Vec<String> = names.into_iter().filter(is_used).collect();
    let has_enough = dark.len() + bright.len() >= MIN_CAMERAS && !dark.is_empty();
    Ok(has_enough.then_some(Found { model, dark, bright, weak }))
}

/// The lenses of a model.
///
/// # Errors
/// Those of most of its photographs cannot be.
fn possible_lenses(model: &Path, photos: &Path) -> Result<Vec<Lens>> {
    let lenses = Dataset::lenses(model)?;
    if let Some(problem) = cameras::mostly_impossible(&lenses) {
        let problem = format!(
            "COLMAP's calibration cannot be, {problem}; mask what moves with the camera (masks/ beside the \
             photographs), take more of them, closer together, or try --camera-model SIMPLE_RADIAL, which has one \
             focal length"
        );
        return Err(Error::input(photos, problem));
    }
    Ok(lenses.into_iter().map(|(lens, _)| lens).collect())
}

/// The pairs that are matched.
fn matcher(options: &PoseOptions, is_clip: bool) -> Result<Matcher> {
    let follows = is_clip && options.with.is_none();
    let default = if follows { Matcher::Sequential } else { Matcher::Exhaustive };
    let matcher = options.matcher.unwrap_or(default);
    if options.with.is_some() && matcher == Matcher::Sequential {
        let problem = "--matcher sequential pairs neighbours by name, and no dark photograph with one of --with; take \
                       exhaustive";
        return Err(Error::Usage(problem.to_owned()));
    }
    Ok(matcher)
}

/// Writes the tone-mapped copies. Bright photographs have a curve of their own, which leaves those in normal light as
/// they are.
fn brighten(
    tone_map: &ToneMapper,
    pictures: &mut PosePhotographs,
    light: Option<StoredLight>,
    report: &dyn Fn(PoseProgress<'_>) -> Result<()>,
) -> Result<()> {
    let PosePhotographs { dark, bright, copies, .. } = pictures;
    let gain = tone_mapped::write(tone_map, dark, light, copies, report)?;
    let count = dark.len();
    report(PoseProgress::Line(&format!("{count} photographs brightened (gain {gain:.1})")))?;
    if !bright.is_empty() {
        let gain = tone_mapped::write(tone_map, bright, None, &copies.join(BRIGHT), report)?;
        let count = bright.len();
        report(PoseProgress::Line(&format!(
            "{count} bright photographs beside them (gain {gain:.1})"
        )))?;
    }
    Ok(())
}

/// Warns of implausible lenses, of cameras that are left out, and of photographs without a camera, of which it names
/// the first.
fn warn_of(
    lenses: &[Lens],
    photographs: &[PathBuf],
    placed: &[String],
    weak: Option<&WeakCameras>,
) {
    for lens in lenses {
        if let Some(problem) = cameras::implausible(lens) {
            tracing::warn!(
                "the calibration of {} is implausible: {problem}; photographs of several lenses may \
                 share it, or overlap too little",
                describe(lens)
            );
        }
    }
    let names = photographs.iter().filter_map(|path| path.file_name()?.to_str());
    let weak_names = weak.map_or(&[][..], |weak| &weak.names);
    let is_placed =
        |name: &&str| placed.iter().chain(weak_names).any(|file| stem(file) == stem(name));
    let without: Vec<String> = names.filter(|name| !is_placed(name)).map(str::to_owned).collect();
    weak.iter().for_each(|weak| tracing::warn!("{}", weak.warning));
    if !without.is_empty() {
        let (count, named) = (without.len(), cameras::first_of(without.into_iter()));
        tracing::warn!("{count} photographs have no camera and are left out: {named}");
    }
    if 2 * placed.len() < photographs.len() {
        tracing::warn!(
            "most photographs have no camera; take more of them, closer together, or expose longer"
        );
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
fn bright_photographs(with: &Path, dark: &Path) -> Result<Vec<PathBuf>> {
    let bright = folder_of(with)?;
    if is_same_file(&bright, dark) {
        let problem = "is the folder of the dark photographs itself; --with takes the bright ones";
        return Err(Error::input(with, problem));
    }
    distinct_photographs(&bright)
}

/// The photographs of a folder.
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
        let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if let Some(other) = seen.insert(stem(&file).to_owned(), file.clone()) {
            let problem = format!("{other} and {file} have the same name; rename one");
            return Err(Error::input(folder, problem));
        }
    }
    Ok(paths)
}
