//! `nightsplat render`: renders a run from the cameras of its dataset or along a path through them.

use std::path::{Path, PathBuf};

use anyhow::Result;
use glam::DVec3;

use super::words::Words;
use super::{ImageFormat, finish, progress_bar, word};
use crate::Error;
use crate::base::output::{check_writable, create_folder, printable};
use crate::camera::{Camera, CameraPath};
use crate::gpu::DeviceChoice;
use crate::photographs::dataset::{Dataset, Split, View};
use crate::photographs::image::{Image, Orientation};
use crate::results::eval::RenderLayer;
use crate::results::finished_run::FinishedRun;
use crate::results::video;
use crate::results::view_exposures::ViewExposures;
use crate::train::TrainConfig;

/// Render a run from the cameras of its dataset, or along a path through them.
///
/// Views need no photograph, only a pose. An interrupted run is rendered at its last checkpoint.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct RenderArgs {
    /// Run directory, or a model with --dataset: PLY, SPZ or SOG
    pub run: PathBuf,
    /// Cameras of this split of the dataset
    #[arg(long, value_enum, required_unless_present = "path", conflicts_with = "path")]
    pub split: Option<SplitChoice>,
    /// Camera path instead of the dataset's cameras
    #[arg(long, value_enum)]
    pub path: Option<PathChoice>,
    /// Frames of the path
    #[arg(long, value_name = "N", default_value_t = 120, requires = "path")]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub frames: u32,
    /// Frames per second of the video
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = clap::value_parser!(u16).range(1..=1000))]
    pub fps: u16,
    /// Also write a video, with ffmpeg, or an animated PNG for FILE.png
    #[arg(long, value_name = "FILE")]
    pub video: Option<PathBuf>,
    /// Folder for the images, one per view; images of the same names are replaced
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Dataset, if it moved since training [default: the run's]
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Layer: rgb, denoised, depth, structure, illumination or noise; depth is scaled to the range of each view, but
    /// in EXR [default: denoised with a denoiser, else rgb]
    #[arg(long, value_parser = Words::<RenderLayer>::new(RenderLayer::ALL.map(RenderLayer::name)))]
    pub layer: Option<RenderLayer>,
    /// Render each training view at the exposure of its target, not at the model's
    #[arg(long)]
    pub view_exposure: bool,
    /// Image format
    #[arg(long, value_enum, default_value_t)]
    pub format: ImageFormat,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the run's]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

const EXAMPLES: &str = "Examples:
  nightsplat render run --split test --out pictures
  nightsplat render run --path auto --frames 180 --out frames --video flight.mp4
  nightsplat render run --path interpolate --out frames --video moving.png";

/// A camera path on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum PathChoice {
    /// Orbit, arc, spiral or interpolate, whichever stays where the cameras are
    Auto,
    /// Circle around the point nearest to all optical axes
    Orbit,
    /// The part of the orbit that the cameras cover, there and back
    Arc,
    /// Two turns about the mean camera, for photographs from one side
    Spiral,
    /// Smooth path through all training cameras by name
    Interpolate,
}

impl PathChoice {
    /// The path around the up direction; logs the choice of `auto`.
    fn path(self, poses: &[Camera], up: DVec3) -> CameraPath {
        match self {
            Self::Auto => {
                let path = CameraPath::suited_about(poses, up);
                let reason = match path {
                    CameraPath::Orbit => "an orbit: the cameras surround the scene",
                    CameraPath::Arc => "an arc: the cameras cover a part of the circle",
                    CameraPath::Spiral => "a spiral: the cameras look in parallel",
                    CameraPath::Interpolate => "through all cameras: they look outwards",
                };
                tracing::info!("the path is {reason}");
                path
            }
            Self::Orbit => CameraPath::Orbit,
            Self::Arc => CameraPath::Arc,
            Self::Spiral => CameraPath::Spiral,
            Self::Interpolate => CameraPath::Interpolate,
        }
    }
}

/// The views to render.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum SplitChoice {
    /// Training views
    Train,
    /// Test views
    Test,
    /// All views
    All,
}

impl SplitChoice {
    fn includes(self, view: &View) -> bool {
        match self {
            Self::Train => view.split == Split::Train,
            Self::Test => view.split == Split::Test,
            Self::All => true,
        }
    }
}

/// An image to render.
struct Shot {
    /// File name without extension.
    name: String,
    camera: Camera,
    /// How its image is rotated for display.
    orientation: Orientation,
}

/// Renders the views or the path.
///
/// # Errors
/// The folder contains no run with a model, its dataset is missing or has no such view, a file cannot be written, or a
/// video requires ffmpeg, which is missing.
pub fn run(args: &RenderArgs) -> Result<()> {
    let RenderArgs { run, out, layer, view_exposure, format, device, .. } = args;
    if let Some(video) = args.video.as_ref().filter(|_| *format == ImageFormat::Exr) {
        let problem =
            format!("--video {} requires PNG frames; leave out --format exr", video.display());
        return Err(Error::Usage(problem).into());
    }
    args.video.iter().chain([out]).try_for_each(|path| check_writable(path))?;
    let FinishedRun { config, dataset, mut model_renderer, .. } =
        FinishedRun::open(run, args.dataset.as_deref(), device.as_ref())?;
    let exposures = if *view_exposure { Some(ViewExposures::of(run)?) } else { None };
    let shots = shots(args, &config, &dataset)?;
    make_folder(out, &dataset, run)?;
    let bar = progress_bar(shots.len());
    for Shot { name, camera, orientation } in &shots {
        bar.set_message(printable(name).into_owned());
        let path = file(out, name, *format);
        let color = |image: Image| {
            let image = image.turned(*orientation);
            match &exposures {
                Some(exposures) => format.save(&exposures.applied(name, image), &path),
                None => format.save(&image, &path),
            }
        };
        match layer {
            None => color(model_renderer.render_camera(camera)?.output().clone())?,
            Some(layer) if layer.is_color() => color(model_renderer.layer(camera, *layer)?)?,
            Some(layer) => {
                let numbers = model_renderer.layer(camera, *layer)?.turned(*orientation);
                save_numbers(numbers, *layer, *format, &path)?;
            }
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    let mut wrote = format!("{} images to {}", shots.len(), out.display());
    if let Some(video) = &args.video {
        let files: Vec<PathBuf> = shots.iter().map(|shot| file(out, &shot.name, *format)).collect();
        video::make(video, out, &files, args.fps)?;
        wrote += &format!(", {}", video.display());
    }
    finish(&wrote, &format!("nightsplat export {} --format html", word(run)))
}

fn file(folder: &Path, name: &str, format: ImageFormat) -> PathBuf {
    folder.join(format!("{name}.{}", format.extension()))
}

/// The images to render.
fn shots(args: &RenderArgs, config: &TrainConfig, dataset: &Dataset) -> crate::Result<Vec<Shot>> {
    let Some(path) = args.path else {
        let includes = |view: &&View| args.split.is_none_or(|split| split.includes(view));
        let views = dataset.views.iter().filter(includes);
        let shot = |view: &View| {
            let View { name, camera, orientation, .. } = view;
            Shot { name: name.clone(), camera: *camera, orientation: *orientation }
        };
        let shots: Vec<Shot> = views.map(shot).collect();
        if shots.is_empty() {
            let problem = "has no view of that split; try --split all";
            return Err(Error::input(&dataset.root, problem));
        }
        return Ok(shots);
    };
    let poses: Vec<Camera> = dataset.train_views().map(View::upright_camera).collect();
    let up = config.up.and_then(|up| DVec3::from_array(up).try_normalize());
    let up = up.unwrap_or_else(|| dataset.up());
    let cameras = path.path(&poses, up).cameras_about(&poses, up, args.frames as usize)?;
    // A mirrored photograph shows a mirrored world.
    let first = dataset.train_views().next().map(|view| view.orientation.mirror());
    let orientation = first.unwrap_or_default();
    // Numbered as ffmpeg expects.
    let shot = |(index, camera)| Shot { name: format!("{index:05}"), camera, orientation };
    Ok((0..).zip(cameras).map(shot).collect())
}

/// Saves a layer that is not colour; EXR keeps the values.
fn save_numbers(
    mut image: Image,
    layer: RenderLayer,
    format: ImageFormat,
    path: &Path,
) -> crate::Result<()> {
    if format == ImageFormat::Exr {
        return image.save_exr_as_stored(path);
    }
    if layer == RenderLayer::Depth {
        let least = image.data.iter().copied().fold(f32::INFINITY, f32::min);
        let largest = image.data.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let scale = 1.0 / (largest - least).max(f32::MIN_POSITIVE);
        image.data.iter_mut().for_each(|value| *value = (*value - least) * scale);
    }
    image.save_png8(path)
}

/// Creates the folder unless it lies in the dataset, where renders would replace photographs of the same names. The run
/// itself may lie there.
fn make_folder(out: &Path, dataset: &Dataset, run: &Path) -> crate::Result<()> {
    create_folder(out)?;
    let is_in = |folder: &Path| {
        let paths = out.canonicalize().ok().zip(folder.canonicalize().ok());
        paths.is_some_and(|(out, folder)| out.starts_with(folder))
    };
    if is_in(&dataset.root) && !is_in(run) {
        return Err(Error::output(out, "lies inside the dataset; choose another --out"));
    }
    Ok(())
}
