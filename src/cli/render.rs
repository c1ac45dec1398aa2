//! `nightsplat render`: pictures of a run from the cameras of its dataset, or along a path through them.

mod video;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Result;
use glam::DVec3;

use super::finished_run::FinishedRun;
use super::{ImageFormat, progress_bar};
use crate::base::output::printable;
use crate::camera::{Camera, CameraPath};
use crate::gpu::DeviceChoice;
use crate::loss::exposure::Affine;
use crate::photographs::dataset::{Dataset, Split, View};
use crate::photographs::image::{Image, Orientation};
use crate::photographs::tone::exposed_anew;
use crate::results::eval::RenderLayer;
use crate::train::TrainConfig;
use crate::{Error, results::run};

/// Render a run from the cameras of its dataset, whether they took an image or not, or along a path through them.
///
/// A run that was stopped is shown as it was at its last checkpoint.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct RenderArgs {
    /// The run directory that `nightsplat train` wrote, or a PLY of Gaussians with --dataset
    pub run: PathBuf,
    /// Which cameras
    #[arg(long, value_enum, required_unless_present = "path", conflicts_with = "path")]
    pub split: Option<SplitChoice>,
    /// Fly in place of standing where the photographs were taken
    #[arg(long, value_enum)]
    pub path: Option<PathChoice>,
    /// How many pictures a path has
    #[arg(long, value_name = "N", default_value_t = 120, requires = "path", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub frames: u32,
    /// Pictures a second of the video
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = clap::value_parser!(u16).range(1..=1000))]
    pub fps: u16,
    /// Make a video of a path's pictures as well, with the ffmpeg on your path; FILE.png: a moving PNG, without it
    #[arg(long, value_name = "FILE", requires = "path")]
    pub video: Option<PathBuf>,
    /// The folder to write to, one picture per view; pictures of the same names are replaced
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Where the dataset is now, or another copy of it; what differs from the run's views is said [default: where the run found it]
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// What to show: rgb, denoised, depth, structure, illumination or noise [default: denoised where the model has a
    /// denoiser, else rgb]. A PNG of depth stretches from the least to the largest value of the view
    #[arg(long)]
    pub layer: Option<RenderLayer>,
    /// Show every training view as bright as its target, where the photographs differ in exposure; without it, and where a
    /// view was not trained on, the model's own exposure
    #[arg(long)]
    pub view_exposure: bool,
    /// The files to write
    #[arg(long, value_enum, default_value_t)]
    pub format: ImageFormat,
    /// The device: uuid:, pci: or index of `nightsplat doctor`, a part of its name, or cpu [default: that of the run]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

const EXAMPLES: &str = "Examples:
  nightsplat render run --split test --out pictures
  nightsplat render run --path auto --frames 180 --out frames --video flight.mp4
  nightsplat render run --path interpolate --out frames --video moving.png";

/// How a camera flies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum PathChoice {
    /// What suits the cameras: an orbit where they surround the scene, an arc over what they cover, a spiral where they look
    /// in parallel, through all of them where they look outwards
    Auto,
    /// Around the point nearest to all optical axes
    Orbit,
    /// Over the part of the orbit that the cameras cover, and back
    Arc,
    /// About the mean camera, two turns; for photographs from one side
    Spiral,
    /// Smoothly through all training cameras by name
    Interpolate,
}

impl PathChoice {
    /// The path about what is up; says which one suits the cameras where that is asked.
    fn path(self, poses: &[Camera], up: DVec3) -> CameraPath {
        match self {
            Self::Auto => {
                let path = CameraPath::suited_about(poses, up);
                let reason = match path {
                    CameraPath::Orbit => "an orbit: the cameras surround the scene",
                    CameraPath::Arc => "an arc: the cameras stand on a part of the circle",
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

/// Views by what they are for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum SplitChoice {
    /// Those trained on.
    Train,
    /// Those held out.
    Test,
    /// Both.
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

/// A picture to be made.
struct Shot {
    /// Its file's name without extension.
    name: String,
    camera: Camera,
    /// How its image is turned to be what people see.
    orientation: Orientation,
}

/// Renders the views, or a path.
///
/// # Errors
/// The folder holds no run with a model, its dataset is gone or has no such view, a file cannot be written, or there is no
/// ffmpeg where a video is asked for.
pub fn run(args: &RenderArgs) -> Result<()> {
    let RenderArgs { run, out, layer, view_exposure, format, device, .. } = args;
    if let Some(video) = &args.video {
        video::check(video, *format)?;
    }
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
    tracing::info!("{} pictures are in {}", shots.len(), out.display());
    if let Some(video) = &args.video {
        let files: Vec<PathBuf> = shots.iter().map(|shot| file(out, &shot.name, *format)).collect();
        video::make(video, out, &files, args.fps)?;
    }
    Ok(())
}

fn file(folder: &Path, name: &str, format: ImageFormat) -> PathBuf {
    folder.join(format!("{name}.{}", format.extension()))
}

/// What is to be seen, from where.
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
    // A mirrored photograph is of a mirrored world.
    let first = dataset.train_views().next().map(|view| view.orientation.mirror());
    let orientation = first.unwrap_or_default();
    // As ffmpeg counts them.
    let shot = |(index, camera)| Shot { name: format!("{index:05}"), camera, orientation };
    Ok((0..).zip(cameras).map(shot).collect())
}

/// The exposures of a run's training views beside the one of its model.
enum ViewExposures {
    /// Gain and bias, learned.
    Learned(BTreeMap<String, Affine>),
    /// Of the targets.
    OfTargets(serde_json::Value),
}

impl ViewExposures {
    fn of(run: &Path) -> crate::Result<Self> {
        let learned = run::load_exposures(run)?;
        if !learned.is_empty() {
            return Ok(Self::Learned(learned));
        }
        let exposure = run::load_metrics(run)[run::TARGET_EXPOSURE].take();
        if exposure["model_gain"].is_number() {
            return Ok(Self::OfTargets(exposure));
        }
        let problem = "has targets of no exposure of their own: its curve has a gain by its constants; leave out --view-exposure";
        Err(Error::input(run, problem))
    }

    /// The model's picture of a view at the exposure of the view's target.
    fn applied(&self, view: &str, mut image: Image) -> Image {
        let number = |value: &serde_json::Value| value.as_f64();
        let exposure = match self {
            Self::Learned(exposures) => {
                let own = exposures.get(view);
                return own.map_or(image.clone(), |own| own.applied(&image));
            }
            Self::OfTargets(exposure) => exposure,
        };
        let gains = number(&exposure["model_gain"]).zip(number(&exposure["gains"][view]));
        let Some((from, to)) = gains else { return image };
        let knots = exposed_anew([from, to], number(&exposure["scene"]["weight"]).unwrap_or(1.0));
        for x in &mut image.data {
            let inside = x.clamp(knots[0][0], knots[knots.len() - 1][0]);
            let above = knots.partition_point(|knot| knot[0] <= inside).clamp(1, knots.len() - 1);
            let [[x0, y0], [x1, y1]] = [knots[above - 1], knots[above]];
            let y = y0 + (inside - x0) / (x1 - x0).max(f32::MIN_POSITIVE) * (y1 - y0);
            *x = y + (*x - inside);
        }
        image
    }
}

/// Numbers that are no colour: an EXR file holds them as they are.
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

/// Makes the folder, unless it is one of the dataset's, where the photographs have the names of the renders. The run
/// itself may lie there.
fn make_folder(out: &Path, dataset: &Dataset, run: &Path) -> crate::Result<()> {
    std::fs::create_dir_all(out)
        .map_err(|error| Error::output(out, format!("cannot be made: {error}")))?;
    let is_in = |folder: &Path| {
        let paths = out.canonicalize().ok().zip(folder.canonicalize().ok());
        paths.is_some_and(|(out, folder)| out.starts_with(folder))
    };
    if is_in(&dataset.root) && !is_in(run) {
        return Err(Error::output(out, "lies inside the dataset; choose another --out"));
    }
    Ok(())
}
