//! `nightsplat render`: renders a run from the cameras of its dataset or along a path through them.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::Result;
use nightsplat_core::camera::Easing;
use nightsplat_core::output::{create_folder, one_line};
use nightsplat_models::linear_light::{Clipped, STOPS, in_unit, photograph_of};
use nightsplat_photographs::dataset::{Dataset, Split, View};
use nightsplat_photographs::image::Image;
use nightsplat_photographs::image::ImageFile as _;
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tree::check_writable;
use nightsplat_report::{colour_map, video};

mod shots;

use self::shots::{Shot, shots};
use super::words::NamedValues;
use super::{OutputFormat, finish, opener, progress_bar, with_dataset};
use crate::Error;
use crate::gpu::DeviceChoice;
use crate::results::eval::RenderLayer;
use crate::results::finished_run::FinishedRun;
use crate::results::view_exposures::ViewExposures;

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
    /// Camera path instead of the dataset's cameras: auto, orbit, arc, spiral or interpolate; or a file with keyframes
    /// (docs/guide.md) or a camera path of nerfstudio
    ///
    /// auto: whichever of the others stays where the cameras are. orbit: a circle around the point nearest to all
    /// optical axes; arc: the part of it that the cameras cover, there and back; spiral: two turns about the mean
    /// camera, for photographs from one side; interpolate: a smooth path through all training cameras by name.
    #[arg(long, value_name = "PATH|FILE")]
    pub path: Option<PathChoice>,
    /// Frames of the path [default: 120, or those of the file]
    #[arg(long, value_name = "N", requires = "path")]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub frames: Option<u32>,
    /// Frames per second of the video [default: 30, or those of the file]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1000))]
    pub fps: Option<u16>,
    /// How time runs along the keyframes of a file [default: the file's, else linear]
    #[arg(long, value_enum, requires = "path")]
    pub easing: Option<EasingChoice>,
    /// Lead from the last keyframe of a file back to the first
    #[arg(long = "loop", requires = "path")]
    pub is_loop: bool,
    /// Size of the images in pixels; the vertical field of view stays [default: the cameras', or the file's]
    #[arg(long, value_name = "WxH")]
    pub size: Option<Size>,
    /// Vertical field of view, degrees, of pinhole cameras
    #[arg(long, value_name = "DEGREES")]
    pub fov: Option<f64>,
    /// Background: black, white, grey, R,G,B from 0 to 1, or #rrggbb
    #[arg(long, value_name = "COLOUR", default_value = "black")]
    pub background: BackgroundColor,
    /// Also write a video, with ffmpeg, or an animated PNG for FILE.png
    #[arg(long, value_name = "FILE")]
    pub video: Option<PathBuf>,
    /// Folder for the images, one per view; images of the same names are replaced [default with --video: none]
    #[arg(long, value_name = "DIR", required_unless_present = "video")]
    pub out: Option<PathBuf>,
    /// Dataset, if it moved since training [default: the run's]
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Layer: rgb, denoised, depth, normal, alpha, transmittance; of a model that has it: depth-feature, structure,
    /// illumination, noise. Depth is the median depth, in colours from near (violet) to far (yellow) in PNG, in world
    /// units in EXR [default: denoised with a denoiser, else rgb]
    #[arg(long, value_parser = NamedValues::<RenderLayer>::new(RenderLayer::ALL.map(RenderLayer::name)))]
    pub layer: Option<RenderLayer>,
    /// Depths at the ends of the colours, in world units [default: of each image its own]
    #[arg(long, value_name = "NEAR,FAR")]
    pub depth_range: Option<DepthRange>,
    /// Light of the images: target, as trained; photograph, as dark as the photographs; linear, the photographs'
    /// linear light at the exposure of the scene, for --format exr: 1 is where they clip, and the header has the stops
    /// to raise it by for the brightness of the target
    #[arg(long = "as", value_name = "LIGHT", value_enum, default_value_t)]
    pub light: Light,
    /// Render each training view at the exposure of its target, not at the model's
    #[arg(long)]
    pub view_exposure: bool,
    /// Let the camera carry the lamp that lit the photographs [default: evenly lit]
    #[arg(long)]
    pub lamp: bool,
    /// Image format
    #[arg(long, value_enum, default_value_t)]
    pub format: OutputFormat,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the run's]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

const EXAMPLES: &str = "Examples:
  nightsplat render run --split test --out pictures
  nightsplat render run --path auto --frames 180 --video flight.mp4
  nightsplat render run --path interpolate --out frames --video moving.png
  nightsplat render run --path keyframes.json --size 1280x720 --video film.mp4
  nightsplat render run --split test --layer depth --out depths
  nightsplat render run --split test --as linear --format exr --out light";

/// The light of an image on the command line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Light {
    /// As trained
    #[default]
    Target,
    /// As dark as the photographs
    Photograph,
    /// Linear, at the exposure of the scene
    Linear,
}

/// A camera path on the command line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PathChoice {
    /// The one that stays where the cameras are.
    Auto,
    /// A path by name.
    Named(nightsplat_core::camera::CameraPath),
    /// A file.
    File(PathBuf),
}

impl FromStr for PathChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        use nightsplat_core::camera::CameraPath;
        Ok(match text {
            "auto" => Self::Auto,
            "orbit" => Self::Named(CameraPath::Orbit),
            "arc" => Self::Named(CameraPath::Arc),
            "spiral" => Self::Named(CameraPath::Spiral),
            "interpolate" => Self::Named(CameraPath::Interpolate),
            file if Path::new(file).is_file() => Self::File(file.into()),
            _ => {
                return Err(
                    "is neither auto, orbit, arc, spiral, interpolate, nor a file".to_owned()
                );
            }
        })
    }
}

/// How time runs along a path on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum EasingChoice {
    /// At the speed of the keyframes
    Linear,
    /// Slow at the first and at the last keyframe
    Smooth,
}

impl From<EasingChoice> for Easing {
    fn from(choice: EasingChoice) -> Self {
        match choice {
            EasingChoice::Linear => Self::Linear,
            EasingChoice::Smooth => Self::Smooth,
        }
    }
}

/// Width and height in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Size(pub [u32; 2]);

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let sides = text.split_once(['x', 'X', ',']);
        let side = |text: &str| text.parse().ok().filter(|side| (1..=65_536).contains(side));
        let size = sides.and_then(|(width, height)| Some([side(width)?, side(height)?]));
        size.map(Self).ok_or_else(|| "is not WIDTHxHEIGHT, such as 1280x720".to_owned())
    }
}

/// A colour, display-referred.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BackgroundColor(pub [f32; 3]);

impl FromStr for BackgroundColor {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let hex = |digits: &str| {
            let number = u32::from_str_radix(digits, 16).ok().filter(|_| digits.len() == 6)?;
            Some([16, 8, 0].map(|shift| (number >> shift & 255) as f32 / 255.0))
        };
        let color = match text {
            "black" => Some([0.0; 3]),
            "white" => Some([1.0; 3]),
            "grey" | "gray" => Some([0.5; 3]),
            _ => match text.strip_prefix('#') {
                Some(digits) => hex(digits),
                None => numbers(text)
                    .filter(|all| all.iter().all(|channel| (0.0..=1.0).contains(channel))),
            },
        };
        color.map(Self).ok_or_else(|| {
            "is no colour: black, white, grey, R,G,B from 0 to 1, or #rrggbb".to_owned()
        })
    }
}

/// Depths at the ends of the colours.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthRange(pub [f32; 2]);

impl FromStr for DepthRange {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let ends = numbers(text).filter(|[near, far]: &[f32; 2]| near < far);
        ends.map(Self).ok_or_else(|| "is not NEAR,FAR, two numbers, the nearer first".to_owned())
    }
}

/// This many finite numbers, separated by commas.
fn numbers<const N: usize>(text: &str) -> Option<[f32; N]> {
    let all: Option<Vec<f32>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
    all?.try_into().ok().filter(|all: &[f32; N]| all.iter().all(|number| number.is_finite()))
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

/// Renders the views or the path.
pub fn run(args: &RenderArgs) -> Result<()> {
    let RenderArgs { run, layer, view_exposure, format, device, .. } = args;
    if let Some(video) = args.video.as_ref().filter(|_| *format == OutputFormat::Exr) {
        let problem =
            format!("--video {} requires PNG frames; leave out --format exr", video.display());
        return Err(Error::Usage(problem).into());
    }
    if args.light == Light::Linear && *format != OutputFormat::Exr {
        let problem = "--as linear is not clamped, and needs floats; add --format exr";
        return Err(Error::Usage(problem.to_owned()).into());
    }
    if args.light != Light::Target && layer.is_some_and(|layer| !layer.is_color()) {
        let problem = "--as photograph and --as linear are of colours; leave out --layer";
        return Err(Error::Usage(problem.to_owned()).into());
    }
    if let Some(fov) = args.fov.filter(|fov| !(*fov > 0.0 && *fov < 180.0)) {
        let problem =
            format!("--fov {fov} is no field of view; it is above 0 and below 180 degrees");
        return Err(Error::Usage(problem).into());
    }
    args.video.iter().chain(&args.out).try_for_each(|path| check_writable(path))?;
    let FinishedRun { config, dataset, mut model_renderer, .. } =
        FinishedRun::open(run, args.dataset.as_deref(), &opener(device.as_ref()))?;
    if args.lamp && !model_renderer.light_as(run, 1.0)? {
        let problem = "has no lamp (lamp.json): its model has not the part lamp; leave out --lamp";
        return Err(Error::input(run, problem).into());
    }
    let exposures = if *view_exposure { Some(ViewExposures::load(run)?) } else { None };
    let (shots, fps) = shots(args, &config, &dataset)?;
    let scene = match args.light {
        Light::Target => None,
        _ => Some(SceneTone::measure(&config.tone, &dataset)?),
    };
    let mut clipped = Clipped::default();
    model_renderer.set_background(args.background.0);
    // The frames of a video alone.
    let mut frames = None;
    let out = match &args.out {
        Some(out) => {
            make_folder(out, &dataset, run)?;
            out.as_path()
        }
        None => frames.insert(tempfile::tempdir()?).path(),
    };
    let bar = progress_bar(shots.len());
    for Shot { name, camera, orientation } in &shots {
        bar.set_message(one_line(name).into_owned());
        let path = file(out, name, *format);
        let mut color = |image: Image| {
            let image = orientation.upright(image);
            let image = match &exposures {
                Some(exposures) => exposures.applied(name, image),
                None => image,
            };
            let Some(scene) = &scene else { return format.save(&image, &path) };
            let view = dataset.views.iter().find(|view| view.name == *name);
            let inverse = match view.filter(|_| args.light == Light::Photograph) {
                Some(view) => scene.inverse(view)?,
                None => scene.inverse_at(camera)?,
            };
            let photograph = clipped.add(photograph_of(&image, &inverse));
            match format {
                OutputFormat::Exr => {
                    // In the unit of the photographs' files.
                    let unit = view.or(dataset.views.first()).map_or(1.0, |view| view.unit);
                    let stops = inverse.stops_to_target() as f32 - unit.log2();
                    in_unit(photograph, unit).save_exr_with(&path, &[(STOPS, stops)])
                }
                _ => format.save(&photograph, &path),
            }
        };
        match layer {
            None => color(model_renderer.render_camera(camera)?.output().clone())?,
            Some(layer) if layer.is_color() => color(model_renderer.layer(camera, *layer)?)?,
            Some(layer) => {
                let numbers = orientation.upright(model_renderer.layer(camera, *layer)?);
                save_numbers(args, numbers, *layer, &path)?;
            }
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    clipped.warn();
    let mut wrote = vec![];
    wrote.extend(
        args.out.as_ref().map(|out| format!("{} images to {}", shots.len(), out.display())),
    );
    if let Some(video) = &args.video {
        let files: Vec<PathBuf> = shots.iter().map(|shot| file(out, &shot.name, *format)).collect();
        let made = video::make(video, out, &files, fps);
        if let (Err(_), Some(frames)) = (&made, &mut frames) {
            // The message says how to make a video of them.
            frames.disable_cleanup(true);
        }
        made?;
        wrote.push(video.display().to_string());
    }
    finish(
        &wrote.join(", "),
        &format!("nightsplat export {} --format html", with_dataset(run, args.dataset.as_deref())),
    );
    Ok(())
}

fn file(folder: &Path, name: &str, format: OutputFormat) -> PathBuf {
    folder.join(format!("{name}.{}", format.extension()))
}

/// Saves a layer that is not colour; EXR keeps the values.
fn save_numbers(
    args: &RenderArgs,
    mut image: Image,
    layer: RenderLayer,
    path: &Path,
) -> crate::Result<()> {
    if args.format == OutputFormat::Exr {
        return image.save_exr_as_stored(path);
    }
    match layer {
        RenderLayer::Depth | RenderLayer::DepthFeature => {
            let plane = &image.data[..image.pixel_count()];
            let range = args.depth_range.map(|range| range.0).or_else(|| colour_map::range(plane));
            image = colour_map::mapped(&image, range.unwrap_or_default());
        }
        RenderLayer::Normal => {
            let is_seen = |normal: [f32; 3]| normal != [0.0; 3];
            let pixels = image.pixel_count();
            for pixel in 0..pixels {
                let normal = [0, 1, 2].map(|plane| image.data[plane * pixels + pixel]);
                let shown = normal.map(|part| if is_seen(normal) { 0.5 + 0.5 * part } else { 0.0 });
                (0..3).for_each(|plane| image.data[plane * pixels + pixel] = shown[plane]);
            }
        }
        _ => {}
    }
    args.format.save(&image, path)
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
