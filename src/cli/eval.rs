//! `nightsplat eval`: scores a run on its test views.

use std::path::PathBuf;

use anyhow::Result;
use indicatif::ProgressBar;
use nightsplat_core::output::{one_line, write_whole};
use nightsplat_photographs::dataset::DOWNSCALE;
use nightsplat_photographs::tree::check_writable;

use super::tell::wrapped;
use super::{finish, opener, print, progress_bar, with_dataset};
use crate::Error;
use crate::gpu::DeviceChoice;
use crate::networks::lpips::Range;
use crate::results::evaluation::{EvalOptions, RunEvaluation};
use crate::results::finished_run::is_model;

/// Score a run on the test views of its dataset.
///
/// Renders every test view that has a reference image in normal light and compares the two at 8 bits: PSNR over all
/// channels, the mean of the three channels' PSNRs (as in the paper's code), and SSIM. Without references, each view is
/// compared with its own pseudo-GT, which the output states: such a score measures how well the model fits its targets,
/// not how good they are. An interrupted run is scored at its last checkpoint.
///
/// The residual transmittance is how much background each view shows: its mean and its 99th percentile. Against a black
/// background no score distinguishes a hole from a dark surface; a mean above 0.1 prints a warning.
#[derive(Clone, Debug, clap::Args)]
pub struct EvalArgs {
    /// Run directory, or a model with --dataset: PLY, SPZ or SOG
    pub run: PathBuf,
    /// Print JSON, as in metrics.json, instead of a table
    #[arg(long)]
    pub json: bool,
    /// Dataset, if it moved since training [default: the run's]
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Folder of reference images that were found since, under the names of the photographs
    #[arg(long, value_name = "DIR")]
    pub reference: Option<PathBuf>,
    /// Score at 1/F of the size of the photographs, for a model that was trained at another [default: the run's]
    #[arg(long, value_name = "F")]
    pub downscale: Option<f64>,
    /// Score the renders of another program in place of the run's: a folder with a picture of every test view, of its
    /// size and under its name
    #[arg(long, value_name = "DIR", conflicts_with_all = ["photographs", "save_images"])]
    pub renders: Option<PathBuf>,
    /// Add the scores after the least-squares gain and bias of each channel of each view, which use the reference
    #[arg(long)]
    pub align: bool,
    /// Add the scores of the renders as dark photographs, against the photographs of the test views: PSNR, by how many
    /// stops the render is brighter, and by how much the tone curve, which multiplies differences, raises that PSNR. A
    /// model that does not state its tone curve is scored against them alone
    #[arg(long)]
    pub photographs: bool,
    /// Add LPIPS, with AlexNet or VGG-16 weights as safetensors (scripts/lpips-weights.py writes them)
    #[arg(long, value_name = "WEIGHTS")]
    pub lpips: Option<PathBuf>,
    /// Input range of the LPIPS network; scores of different ranges or networks do not compare
    #[arg(long, value_name = "RANGE", value_enum, default_value_t, requires = "lpips")]
    pub lpips_range: LpipsRange,
    /// Add SSIM with a uniform window of 7x7 and sample covariances, as scikit-image's default and RealX3D's tables
    #[arg(long)]
    pub uniform_ssim: bool,
    /// Write renders and references (or targets) to RUN/eval; of MODEL.ply, to MODEL.eval
    #[arg(long)]
    pub save_images: bool,
    /// Write a page with scores, error maps, the worst view and the history of training
    #[arg(long, value_name = "FILE.html")]
    pub report: Option<PathBuf>,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the run's]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// The range of LPIPS inputs on the command line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum LpipsRange {
    /// [-1, 1], as LPIPS was trained: `normalize=True` in lpips and torchmetrics, gsplat's AlexNet
    #[default]
    Signed,
    /// [0, 1], as in the code of 3DGS, gsplat's VGG-16 and papers that follow them
    Unit,
}

impl From<LpipsRange> for Range {
    fn from(range: LpipsRange) -> Self {
        match range {
            LpipsRange::Signed => Self::Signed,
            LpipsRange::Unit => Self::Unit,
        }
    }
}

/// Scores the run and prints the scores.
pub fn run(args: &EvalArgs) -> Result<()> {
    args.report.iter().try_for_each(|path| check_writable(path))?;
    if let Some(downscale) = args.downscale.filter(|factor| !DOWNSCALE.takes_number(*factor)) {
        let (key, rule) = ("downscale".to_owned(), DOWNSCALE.to_string());
        return Err(Error::Setting { key, value: downscale.to_string(), rule }.into());
    }
    let images = match is_model(&args.run) {
        true => args.run.with_extension("eval"),
        false => args.run.join("eval"),
    };
    let images = args.save_images.then_some(images);
    let options = EvalOptions {
        dataset: args.dataset.as_deref(),
        reference: args.reference.as_deref(),
        downscale: args.downscale,
        renders: args.renders.as_deref(),
        opener: opener(args.device.as_ref()),
        lpips: args.lpips.as_deref().map(|weights| (weights, args.lpips_range.into())),
        uniform_ssim: args.uniform_ssim,
        align: args.align,
        photographs: args.photographs,
        images: images.as_deref(),
        with_page: args.report.is_some(),
    };
    let mut bar = None;
    let scored = RunEvaluation::new(&args.run, &options, |index, count, view| {
        let bar = bar.get_or_insert_with(|| progress_bar(count));
        bar.set_position(index as u64);
        bar.set_message(one_line(view).into_owned());
    });
    bar.iter().for_each(ProgressBar::finish_and_clear);
    let scored = scored?;
    if let Some(path) = &args.report {
        write_whole(path, scored.html().as_bytes())?;
    }
    if args.json {
        return Ok(print(format_args!("{:#}", scored.json()))?);
    }
    print(scored.evaluation.table().text())?;
    scored.notes().iter().try_for_each(|note| print(wrapped(&one_line(note), 0)))?;
    let wrote = args.report.iter().chain(&images).map(|path| path.display().to_string());
    let run = with_dataset(&args.run, args.dataset.as_deref());
    let next = format!("nightsplat render {run} --split all --out pictures");
    finish(&wrote.collect::<Vec<_>>().join(", "), &next);
    Ok(())
}
