//! `nightsplat pose`: estimates the cameras of photographs with COLMAP.

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Result;
use indicatif::ProgressBar;
use nightsplat_photographs::image::StoredLight;

use super::{finish, progress_bar, signals, tell_on_stderr, word};
use crate::driver;
use crate::gpu::DeviceChoice;
use crate::results::run::Requests;
use crate::targets::pseudo_gt::PseudoGt;
use nightsplat_pose::{
    Mapper, Matcher, PoseFeatures, PoseOptions, PoseProgress, PoseWatch, Posed, ToneMapper,
    describe, estimate,
};

/// Estimate the cameras of dark photographs with COLMAP, and write a dataset for `train`.
///
/// COLMAP finds few features in dark photographs. This command brightens them first, all by the same curve, runs your
/// `colmap` on the result, and writes a dataset of the original photographs with the cameras that it found. The focal
/// length in a JPEG's Exif is the initial value. Frames of a clip are extracted with your `ffmpeg`: the sharpest of
/// each 1 / --fps seconds.
///
/// SIGINT, SIGTERM and SIGHUP end COLMAP and keep what it has found; the same command goes on there, also after a kill.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = EXAMPLE)]
pub struct PoseArgs {
    /// Folder of photographs of one scene, or a clip (.mp4, .mov, .mkv)
    pub photos: PathBuf,
    /// Dataset to write; it appears when complete
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    #[command(flatten)]
    pub(super) choices: PoseChoices,
    /// How integer files store light: srgb, with levels as their formats say, or linear, as RAW converters and machine
    /// vision write sensor values [default: srgb, and levels that the values show]
    #[arg(long, value_name = "LIGHT")]
    pub light: Option<StoredLight>,
    /// Replace a dataset that `pose` wrote
    #[arg(long)]
    pub overwrite: bool,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// How cameras are found.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct PoseChoices {
    /// Bright photographs of the same scene, from any views: the dark ones are posed through them. Their own dataset is
    /// `bright` in that of the dark ones
    #[arg(long, value_name = "DIR")]
    with: Option<PathBuf>,
    /// Path of COLMAP
    #[arg(long, value_name = "PATH", default_value = "colmap")]
    colmap: PathBuf,
    /// Match every pair, or neighbours by name [default: sequential for a clip, else exhaustive]
    #[arg(long, value_enum)]
    matcher: Option<Matcher>,
    /// The features that are matched [default: SIFT, then learned ones where most photographs have no camera and this
    /// COLMAP has them]
    #[arg(long, value_enum)]
    features: Option<PoseFeatures>,
    /// Register cameras one by one, or all at once, which is faster for many photographs
    #[arg(long, value_enum, default_value_t = Mapper::Incremental)]
    mapper: Mapper,
    /// Path of GLOMAP, for --mapper global with COLMAP before 4.0
    #[arg(long, value_name = "PATH", default_value = "glomap")]
    glomap: PathBuf,
    /// Option of a COLMAP command, as `Mapper.init_min_tri_angle=4`; may be given again
    #[arg(long, value_name = "NAME=VALUE")]
    colmap_option: Vec<String>,
    /// COLMAP camera model; photographs of one size, lens and focal length share a camera
    #[arg(long, value_name = "NAME", default_value = "OPENCV")]
    camera_model: String,
    /// Frames per second to extract from a clip
    #[arg(long, value_name = "F", default_value_t = 2.0)]
    fps: f64,
    /// Path of ffmpeg, for clips
    #[arg(long, value_name = "PATH", default_value = "ffmpeg")]
    ffmpeg: PathBuf,
    /// Where few photographs are registered, try again for at most this many times the time of the first attempt
    #[arg(long, value_name = "F", default_value_t = 2.0)]
    patience: f64,
    /// Let COLMAP use the GPU, which requires a display or CUDA
    #[arg(long)]
    colmap_gpu: bool,
}

const EXAMPLE: &str = "Example:
  nightsplat pose photos --out scene
  nightsplat pose night --with day --out scene
  nightsplat train scene --out run";

/// Maximum number of lenses that are listed.
const MAX_LISTED: usize = 3;

/// Estimates the cameras and writes the dataset.
pub fn run(args: &PoseArgs) -> Result<()> {
    let options = PoseOptions {
        overwrite: args.overwrite,
        light: args.light,
        ..args.choices.options(&args.photos, &args.out)
    };
    let device = args.device.clone().unwrap_or_default();
    let wrote = posed(&options, &device, "", &signals::requests()?)?;
    finish(&wrote, &format!("nightsplat train {} --out run", word(&args.out)));
    Ok(())
}

/// Estimates the cameras of photographs that a device brightens, with a prefix of each line, and returns what was
/// written.
pub(super) fn posed(
    options: &PoseOptions,
    device: &DeviceChoice,
    prefix: &str,
    requests: &Requests,
) -> Result<String> {
    let begin = Instant::now();
    let bar: RefCell<Option<ProgressBar>> = RefCell::default();
    let report = |progress: PoseProgress<'_>| match progress {
        PoseProgress::Line(line) => {
            let seconds = begin.elapsed().as_secs_f64();
            tell_on_stderr(format_args!("{prefix}{seconds:5.0} s  {line}"));
        }
        PoseProgress::Photographs { done, all } => {
            let mut bar = bar.borrow_mut();
            bar.get_or_insert_with(|| progress_bar(all)).set_position(done as u64);
            if done == all {
                bar.take().iter().for_each(ProgressBar::finish_and_clear);
            }
        }
    };
    let watch = PoseWatch { report: &report, stops: &|| requests.stops() };
    let Posed { photographs, placed, bright, lenses } =
        estimate(options, &|| tone_mapper(device), &watch)?;
    let bright = bright.map(|[placed, all]| format!(" and {placed} of {all} bright ones"));
    Ok(format!(
        "{}: {placed} of {photographs} photographs{} with their cameras, {} calibrated ({})",
        options.out.display(),
        bright.unwrap_or_default(),
        if lenses.len() == 1 { "one".to_owned() } else { lenses.len().to_string() },
        lenses.iter().take(MAX_LISTED).map(describe).collect::<Vec<_>>().join("; ")
    ))
}

/// Tone-maps on a device.
fn tone_mapper(device: &DeviceChoice) -> crate::Result<ToneMapper> {
    let gpu = driver::open(device)?;
    Ok(Box::new(move |scene, photograph, measured| {
        PseudoGt::new(&gpu, scene.settings())?.tone_mapped(photograph, &scene.curve_of(measured))
    }))
}

impl PoseChoices {
    /// The options for these photographs and the dataset to write.
    pub(super) fn options(&self, photos: &Path, out: &Path) -> PoseOptions {
        let choices = self.clone();
        PoseOptions {
            photos: photos.to_owned(),
            with: choices.with,
            out: out.to_owned(),
            overwrite: false,
            colmap: choices.colmap,
            glomap: choices.glomap,
            ffmpeg: choices.ffmpeg,
            patience: choices.patience,
            matcher: choices.matcher,
            features: choices.features,
            mapper: choices.mapper,
            colmap_options: choices.colmap_option,
            camera_model: choices.camera_model,
            colmap_gpu: choices.colmap_gpu,
            fps: choices.fps,
            light: None,
        }
    }
}
