//! `nightsplat eval`: scores a run on its test views.

use std::io::Write;
use std::path::PathBuf;

use anyhow::Result;

use super::{driver, finish, progress_bar, table, word};
use crate::Error;
use crate::base::output::{check_writable, printable, write_whole};
use crate::gpu::DeviceChoice;
use crate::networks::lpips::{Lpips, Range};
use crate::photographs::dataset::{DOWNSCALE, View};
use crate::photographs::metrics::psnr_of_counted;
use crate::photographs::targets::SceneTone;
use crate::results::eval::{self, ScoreReference, ScoredImages};
use crate::results::evaluation::{EvalPage, score_table};
use crate::results::finished_run::{FinishedRun, is_model};
use crate::results::linear_light::{photograph_of, slope_at, stops_between};
use crate::results::run;
use crate::train::{OnOff, known_stops};

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
    /// Add the scores after the least-squares gain and bias of each channel of each view, which use the reference
    #[arg(long)]
    pub align: bool,
    /// Add the scores of the renders as dark photographs, against the photographs of the test views: PSNR, by how many
    /// stops the render is brighter, and by how much the tone curve, which multiplies differences, raises that PSNR
    #[arg(long)]
    pub photographs: bool,
    /// Add LPIPS, with AlexNet or VGG-16 weights as safetensors (scripts/lpips-weights.py writes them)
    #[arg(long, value_name = "WEIGHTS")]
    pub lpips: Option<PathBuf>,
    /// Input range of the LPIPS network; scores of different ranges or networks do not compare
    #[arg(long, value_name = "RANGE", value_enum, default_value_t, requires = "lpips")]
    pub lpips_range: LpipsRange,
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

/// PSNR of a render as a photograph against the photograph of its view, the stops by which it is brighter, and the
/// slope of the tone curve; `None` if the view has no photograph.
fn as_photograph(
    scene: &SceneTone,
    compared: &ScoredImages<'_>,
) -> crate::Result<Option<[f64; 3]>> {
    let Some(photograph) = compared.view.loaded()? else { return Ok(None) };
    let inverse = scene.inverse(compared.view)?;
    let (own, _) = photograph_of(&compared.render, &inverse);
    let mask = compared.view.mask.as_ref();
    let psnr = psnr_of_counted(&own, &photograph, mask)?;
    let slope = slope_at(&compared.render, &inverse);
    Ok(Some([psnr, stops_between(&own, &photograph), slope]))
}

/// Scores the run and prints the scores.
pub fn run(args: &EvalArgs) -> Result<()> {
    args.report.iter().try_for_each(|path| check_writable(path))?;
    if let Some(downscale) = args.downscale.filter(|&own| !DOWNSCALE.takes_number(own)) {
        let (key, rule) = ("downscale".to_owned(), DOWNSCALE.to_string());
        return Err(Error::Setting { key, value: downscale.to_string(), rule }.into());
    }
    let FinishedRun { gpu, config, dataset, gaussian_count, mut model_renderer, lamp } =
        FinishedRun::open_with(
            &args.run,
            args.dataset.as_deref(),
            &driver::opener(args.device.as_ref()),
            |own| {
                own.reference = args.reference.clone().or(own.reference.take());
                own.downscale = args.downscale.unwrap_or(own.downscale);
            },
        )?;
    model_renderer.set_lamp(lamp)?;
    let load = |weights| Lpips::load(&gpu, weights, args.lpips_range.into());
    let lpips = args.lpips.as_ref().map(load).transpose()?;
    let measure = lpips.as_ref().map(Lpips::measure);
    let scene = args.photographs.then(|| SceneTone::measure(&config.tone, &dataset)).transpose()?;
    let stops = known_stops(&dataset, &config)?;
    let mut score_reference = ScoreReference::of(&gpu, &config.tone, &dataset)?;
    let images = match is_model(&args.run) {
        true => args.run.with_extension("eval"),
        false => args.run.join("eval"),
    };
    let mut page = args.report.as_ref().map(|_| EvalPage::default());
    let bar = progress_bar(score_reference.view_count(&dataset));
    let is_even = score_reference.is_evenly_lit(&dataset);
    let render = |view: &View| {
        bar.set_message(printable(&view.name).into_owned());
        model_renderer.render_as(view, is_even)
    };
    let mut scored = eval::score_by(&mut score_reference, &dataset, render, |score, compared| {
        let lpips = lpips.as_ref().map(|lpips| compared.lpips(&gpu, lpips));
        score.scores.lpips = lpips.transpose()?;
        if args.align || config.exposure.learn == OnOff::On {
            score.aligned = Some(compared.aligned()?);
        }
        if let Some(stops) = stops.get(&score.name) {
            score.exposed = Some(compared.exposed(*stops)?);
        }
        if let Some(scene) = &scene {
            score.photograph = as_photograph(scene, compared)?;
        }
        if args.save_images {
            compared.save(&images, score.against)?;
        }
        if let Some(page) = &mut page {
            page.add(score, compared);
        }
        bar.inc(1);
        Ok(())
    })?;
    bar.finish_and_clear();
    if lamp.is_some() {
        eval::score_lit(&mut scored, &dataset, |view| model_renderer.render(view))?;
    }
    eval::warn_of_holes(&scored, &dataset, config.background, |view| model_renderer.render(view))?;
    if scored.is_empty() {
        let root = dataset.root.display();
        tracing::warn!(
            "{root}: no test view has a reference image or a photograph: nothing to score"
        );
    }
    let mut wrote = vec![];
    if let (Some(page), Some(path)) = (page, &args.report) {
        write_whole(path, page.html(&args.run, &scored, measure).as_bytes())?;
        wrote.push(path.display().to_string());
    }
    wrote.extend(args.save_images.then(|| images.display().to_string()));
    let mut out = std::io::stdout().lock();
    if args.json {
        let recorded = run::load_metrics(&args.run);
        let seconds = recorded["seconds"].as_f64();
        let steps = recorded["steps"].as_u64().or_else(|| run::stopped_at(&args.run));
        let steps = steps.unwrap_or(config.steps);
        let mut metrics = eval::metrics(&scored, seconds, gaussian_count, steps);
        if is_model(&args.run) {
            metrics["steps"] = serde_json::Value::Null;
        }
        if let Some(measure) = measure {
            eval::add_lpips(&mut metrics, &scored, measure);
        }
        eval::add_reference(&mut metrics, &config.tone);
        for what in
            [run::SPENT, run::TARGET_EXPOSURE, run::ENDED, run::TRAINED_WITH, run::HELD_OUT_CURVE]
        {
            if let Some(known) = recorded.get(what) {
                metrics[what] = known.clone();
            }
        }
        if config.exposure.learn == OnOff::On {
            eval::add_exposure(&mut metrics, &scored);
        } else if args.align {
            eval::add_aligned(&mut metrics, &scored);
        }
        eval::add_exposed(&mut metrics, &scored);
        eval::add_lit(&mut metrics, &scored);
        if args.photographs {
            eval::add_photographs(&mut metrics, &scored);
        }
        writeln!(out, "{metrics:#}")?;
    } else {
        write!(out, "{}", table::of(&score_table(&scored, measure)))?;
        if let Some(known) = config.tone.knows_references() {
            writeln!(out, "{}", eval::with_reference(&known))?;
        }
        if let Some(lit) = eval::mean_lit(&scored) {
            writeln!(
                out,
                "in the lamp's light, against lit/, after gain and bias of each channel: PSNR {:.2} dB, SSIM {:.3}",
                lit.psnr, lit.ssim
            )?;
        }
        if let Some([.., slope]) = eval::mean_photograph(&scored) {
            writeln!(
                out,
                "the tone curve multiplies differences of the photographs by {slope:.2}: {:.2} dB of PSNR, dark",
                20.0 * slope.log10()
            )?;
        }
        if let Some(label) = eval::label(&scored) {
            writeln!(out, "{label}")?;
        }
        let run = word(&args.run);
        finish(&wrote.join(", "), &format!("nightsplat render {run} --split all --out pictures"))?;
    }
    Ok(())
}
