//! `nightsplat render`: pictures of a finished run from the cameras of its dataset.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Result;

use super::finished_run::FinishedRun;
use super::{ImageFormat, progress_bar};
use crate::dataset::{Dataset, Split, View};
use crate::eval::Layer;
use crate::exposure::Affine;
use crate::gpu::DeviceChoice;
use crate::image::Image;
use crate::output::printable;
use crate::tone::exposed_anew;
use crate::{Error, run};

/// Render a finished run from the cameras of its dataset, whether they took an image or not.
#[derive(Clone, Debug, clap::Args)]
pub struct RenderArgs {
    /// The run directory that `nightsplat train` wrote
    pub run: PathBuf,
    /// Which cameras
    #[arg(long, value_enum)]
    pub split: SplitChoice,
    /// The folder to write to, one picture per view; pictures of the same names are replaced
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// What to show: rgb, denoised, depth, structure, illumination or noise [default: denoised where the model has a
    /// denoiser, else rgb]. A PNG of depth stretches from the least to the largest value of the view
    #[arg(long)]
    pub layer: Option<Layer>,
    /// Show every training view as bright as its target, where the photographs differ in exposure; without it, and where a
    /// view was not trained on, the model's own exposure
    #[arg(long)]
    pub view_exposure: bool,
    /// The files to write
    #[arg(long, value_enum, default_value_t)]
    pub format: ImageFormat,
    /// The device: a part of its name or its index in `nightsplat doctor` [default: that of the run]
    #[arg(long, value_name = "NAME|INDEX")]
    pub device: Option<DeviceChoice>,
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

/// Renders the views.
///
/// # Errors
/// The folder holds no finished run, its dataset is gone or has no such view, or a file cannot be written.
pub fn run(args: &RenderArgs) -> Result<()> {
    let RenderArgs { run, split, out, layer, view_exposure, format, device } = args;
    let FinishedRun { dataset, mut player, .. } = FinishedRun::open(run, device.as_ref())?;
    let exposures = if *view_exposure { Some(ViewExposures::of(run)?) } else { None };
    let views: Vec<&View> = dataset.views.iter().filter(|view| split.includes(view)).collect();
    if views.is_empty() {
        let problem = "has no view of that split; try --split all";
        return Err(Error::input(&dataset.root, problem).into());
    }
    make_folder(out, &dataset, run)?;
    let bar = progress_bar(views.len());
    for view in &views {
        bar.set_message(printable(&view.name).into_owned());
        let path = out.join(format!("{}.{}", view.name, format.extension()));
        let color = |image: Image| match &exposures {
            Some(exposures) => format.save(&exposures.applied(view, image), &path),
            None => format.save(&image, &path),
        };
        match layer {
            None => color(player.render(view)?.output().clone())?,
            Some(layer) if layer.is_color() => color(player.layer(view, *layer)?)?,
            Some(layer) => save_numbers(player.layer(view, *layer)?, *layer, *format, &path)?,
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    tracing::info!("{} pictures are in {}", views.len(), out.display());
    Ok(())
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
    fn applied(&self, view: &View, mut image: Image) -> Image {
        let number = |value: &serde_json::Value| value.as_f64();
        let exposure = match self {
            Self::Learned(exposures) => {
                let own = exposures.get(&view.name);
                return own.map_or(image.clone(), |own| own.applied(&image));
            }
            Self::OfTargets(exposure) => exposure,
        };
        let gains = number(&exposure["model_gain"]).zip(number(&exposure["gains"][&view.name]));
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
    layer: Layer,
    format: ImageFormat,
    path: &Path,
) -> crate::Result<()> {
    if format == ImageFormat::Exr {
        return image.save_exr_as_stored(path);
    }
    if layer == Layer::Depth {
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
