//! `nightsplat eval`: score a run on its test views.

use std::io::Write;
use std::path::PathBuf;

use anyhow::Result;

use super::finished_run::{FinishedRun, is_model};
use super::{progress_bar, table};
use crate::base::output::printable;
use crate::gpu::DeviceChoice;
use crate::networks::lpips::{Lpips, Measure, Range};
use crate::photographs::dataset::View;
use crate::photographs::metrics::Scores;
use crate::results::eval::{self, ResidualTransmittance, ScoreReference, ViewScore};
use crate::results::run;
use crate::train::OnOff;

/// Score a run on the test views of its dataset.
///
/// Renders every test view that has a normal-light reference image and compares the two in 8 bits: PSNR over all
/// channels, the mean of the three channels' PSNRs (what the paper's code computes), and SSIM. Where no test view has one,
/// each is compared with its own pseudo-GT, what the run's curve makes of its photograph, and that is said: it tells how
/// well the model shows its targets, not how right these are. A run that was stopped is scored as it was at its last
/// checkpoint.
///
/// Beside the scores stands the leftover transmittance, how much of the background each view shows: its mean, and what 99 %
/// of the pixels stay below. No score tells a hole before black from a dark surface; a mean above 0.1 is a warning.
#[derive(Clone, Debug, clap::Args)]
pub struct EvalArgs {
    /// The run directory that `nightsplat train` wrote, or a PLY of Gaussians with --dataset
    pub run: PathBuf,
    /// Print what metrics.json holds instead of a table
    #[arg(long)]
    pub json: bool,
    /// Where the dataset is now, or another copy of it; what differs from the run's views is said [default: where the run found it]
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Score LPIPS too, the distance of two pictures to the eye of AlexNet or VGG-16: lower is more alike. The safetensors
    /// file of weights tells which network it is; scripts/lpips-weights.py writes those that are published
    #[arg(long, value_name = "WEIGHTS")]
    pub lpips: Option<PathBuf>,
    /// What LPIPS gives its network of a picture in [0, 1]; numbers of different ranges or networks do not compare, so take
    /// what the table you compare with took
    #[arg(long, value_name = "RANGE", value_enum, default_value_t, requires = "lpips")]
    pub lpips_range: LpipsRange,
    /// Write what was scored to RUN/eval/renders, and what it was compared with to RUN/eval/references or RUN/eval/targets; of MODEL.ply, below MODEL.eval
    #[arg(long)]
    pub save_images: bool,
    /// The device: uuid:, pci: or index of `nightsplat doctor`, a part of its name, or cpu [default: that of the run]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// `Range` on the command line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum LpipsRange {
    /// Stretched to [-1, 1], for which the measure was made: `normalize=True` in lpips and torchmetrics, gsplat's AlexNet
    #[default]
    Signed,
    /// As it is, an oversight that became a custom: the code of 3DGS, gsplat's VGG-16, and papers that follow them
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
///
/// # Errors
/// The folder holds no run with a model, its dataset is gone, or a file cannot be written.
pub fn run(args: &EvalArgs) -> Result<()> {
    let FinishedRun { gpu, config, dataset, gaussian_count, mut model_renderer } =
        FinishedRun::open(&args.run, args.dataset.as_deref(), args.device.as_ref())?;
    let load = |weights| Lpips::load(&gpu, weights, args.lpips_range.into());
    let lpips = args.lpips.as_ref().map(load).transpose()?;
    let measure = lpips.as_ref().map(Lpips::measure);
    let mut score_reference = ScoreReference::of(&gpu, &config.tone, &dataset)?;
    let images = match is_model(&args.run) {
        true => args.run.with_extension("eval"),
        false => args.run.join("eval"),
    };
    let bar = progress_bar(score_reference.view_count(&dataset));
    let render = |view: &View| {
        bar.set_message(printable(&view.name).into_owned());
        model_renderer.render(view)
    };
    let scored = eval::score_by(&mut score_reference, &dataset, render, |score, compared| {
        let lpips = lpips.as_ref().map(|lpips| compared.lpips(&gpu, lpips));
        score.scores.lpips = lpips.transpose()?;
        if config.exposure.learn == OnOff::On {
            score.aligned = Some(compared.aligned()?);
        }
        if args.save_images {
            compared.save(&images, score.against)?;
        }
        bar.inc(1);
        Ok(())
    })?;
    bar.finish_and_clear();
    eval::warn_of_holes(&scored, &dataset, config.background, |view| model_renderer.render(view))?;
    if scored.is_empty() {
        let root = dataset.root.display();
        tracing::warn!(
            "{root}: no test view has a reference image or a photograph, so there is nothing to score"
        );
    }
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
        for what in [run::SPENT, run::TARGET_EXPOSURE, run::ENDED, run::HELD_OUT_CURVE] {
            if let Some(known) = recorded.get(what) {
                metrics[what] = known.clone();
            }
        }
        if config.exposure.learn == OnOff::On {
            eval::add_exposure(&mut metrics, &scored);
        }
        writeln!(out, "{metrics:#}")?;
    } else {
        write!(out, "{}", score_table(&scored, measure))?;
        if let Some(known) = config.tone.knows_references() {
            writeln!(out, "{}", eval::with_reference(&known))?;
        }
        if let Some(label) = eval::label(&scored) {
            writeln!(out, "{label}")?;
        }
    }
    Ok(())
}

fn score_table(scored: &[ViewScore], measure: Option<Measure>) -> String {
    let (mean, mean_r0) = eval::means(scored);
    let mut header = ["view", "PSNR", "channel mean", "SSIM"].map(str::to_owned).to_vec();
    header.extend(measure.map(Measure::title));
    // Before the denoiser.
    header.extend(mean_r0.iter().flat_map(|_| ["PSNR of R_0", "SSIM of R_0"]).map(str::to_owned));
    let mean_transmittance =
        ResidualTransmittance::mean(scored.iter().filter_map(|view| view.residual_transmittance));
    header.extend(mean_transmittance.iter().flat_map(|_| ["leftover", "99 %"]).map(str::to_owned));
    let row = |name: &str,
               scores: &Scores,
               r0: Option<&Scores>,
               residual_transmittance: Option<ResidualTransmittance>| {
        let Scores { psnr, psnr_channel_mean, ssim, lpips } = scores;
        let mut row = vec![
            name.to_owned(),
            format!("{psnr:.2}"),
            format!("{psnr_channel_mean:.2}"),
            format!("{ssim:.4}"),
        ];
        row.extend(lpips.map(|lpips| format!("{lpips:.4}")));
        row.extend(
            r0.into_iter().flat_map(|r0| [format!("{:.2}", r0.psnr), format!("{:.4}", r0.ssim)]),
        );
        let residual_transmittance =
            residual_transmittance.into_iter().flat_map(|own| [own.mean, own.q99]);
        row.extend(residual_transmittance.map(|value| format!("{value:.4}")));
        row
    };
    let mut rows = vec![header];
    let of_view = |view: &ViewScore| {
        row(&view.name, &view.scores, view.r0.as_ref(), view.residual_transmittance)
    };
    rows.extend(scored.iter().map(of_view));
    rows.extend(mean.map(|mean| row("mean", &mean, mean_r0.as_ref(), mean_transmittance)));
    table::aligned(&rows)
}
