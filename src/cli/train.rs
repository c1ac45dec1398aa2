//! `nightsplat train`: dark photographs in, a run directory out.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Result;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::dataset::Dataset;
use crate::eval::{self, ViewScore};
use crate::export::RunDirectory;
use crate::gpu::{DeviceChoice, Gpu};
use crate::metrics::Scores;
use crate::tone::{ToneCurve, ToneSettings};
use crate::train::{Background, TrainConfig, Trainer};

/// Train a 3D Gaussian Splatting model from dark photographs.
///
/// Each photograph is lifted by a tone curve into the pseudo-GT that supervises training; normal-light reference images,
/// where the dataset has them, are only ever used for scores.
#[derive(Clone, Debug, clap::Args)]
pub struct TrainArgs {
    /// The dataset: a folder with transforms*.json (LOM, RealX3D, NeRF) or a COLMAP model in sparse/
    pub dataset: PathBuf,
    /// The run directory to write: config.toml, model.ply, train.csv, metrics.json
    #[arg(long, value_name = "RUN")]
    pub out: PathBuf,
    /// Replace the run that RUN already holds
    #[arg(long)]
    pub overwrite: bool,
    #[command(flatten)]
    pub(crate) options: TrainOptions,
}

/// The options of a run; each wins over the configuration file.
#[derive(Clone, Debug, Default, clap::Args)]
pub(crate) struct TrainOptions {
    /// The tone curve: linear, ase, ap3 or none [default: ap3]
    #[arg(long)]
    curve: Option<ToneCurve>,
    /// c: how much a brighter photograph raises the curve's gain [default: 3 for ase, 1 for ap3]
    #[arg(long, value_name = "C")]
    gain: Option<f64>,
    /// The mean that the linear curve aims at [default: 0.49]
    #[arg(long, value_name = "T")]
    theta: Option<f64>,
    /// Training steps, one view each [default: 5000]
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Shrink the photographs by this factor [default: 1]
    #[arg(long, value_name = "F")]
    downscale: Option<f64>,
    /// Everything random follows from it; the same seed gives the same bits [default: 10]
    #[arg(long, value_name = "S")]
    seed: Option<u64>,
    /// Highest degree of the spherical harmonics, 0 to 3 [default: 3]
    #[arg(long, value_name = "D")]
    sh_degree: Option<u32>,
    /// Weight of 1 - SSIM beside L1, 0 to 1 [default: 0.2]
    #[arg(long, value_name = "W")]
    ssim_weight: Option<f64>,
    /// Never grow beyond this many Gaussians [default: 1000000]
    #[arg(long, value_name = "N")]
    max_gaussians: Option<usize>,
    /// black, or random: another colour every step [default: black]
    #[arg(long)]
    background: Option<Background>,
    /// A folder of reference images by name, for scores only
    #[arg(long, value_name = "DIR")]
    reference: Option<PathBuf>,
    /// The device: a part of its name or its index in `nightsplat doctor` [default: the best]
    #[arg(long, value_name = "NAME|INDEX")]
    device: Option<String>,
    /// A TOML file with any of the settings of a run's config.toml
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Score the test views every N steps as well as at the end
    #[arg(long, value_name = "N")]
    eval_every: Option<u64>,
    /// Any other setting by its place in config.toml, such as tone.alpha=0.1; may be repeated, wins over all else
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

impl TrainOptions {
    /// The configuration: defaults, then the file, then the command line.
    pub(crate) fn config(&self, dataset: PathBuf) -> crate::Result<TrainConfig> {
        let mut config =
            self.config.as_deref().map_or_else(|| Ok(TrainConfig::default()), TrainConfig::load)?;
        config.dataset = dataset;
        if let Some(curve) = self.curve.filter(|&curve| curve != config.tone.curve) {
            // Another curve brings its own c; the other constants stay.
            config.tone =
                ToneSettings { curve, gain_c: ToneSettings::new(curve).gain_c, ..config.tone };
        }
        fn set<T: Clone>(value: &mut T, option: &Option<T>) {
            if let Some(option) = option {
                value.clone_from(option);
            }
        }
        set(&mut config.tone.gain_c, &self.gain);
        set(&mut config.tone.theta, &self.theta);
        set(&mut config.steps, &self.steps);
        set(&mut config.downscale, &self.downscale);
        set(&mut config.seed, &self.seed);
        set(&mut config.sh_degree, &self.sh_degree);
        set(&mut config.ssim_weight, &self.ssim_weight);
        set(&mut config.max_gaussians, &self.max_gaussians);
        set(&mut config.background, &self.background);
        set(&mut config.device, &self.device);
        set(&mut config.eval_every, &self.eval_every);
        if self.reference.is_some() {
            config.reference.clone_from(&self.reference);
        }
        let config = config.with(&self.set)?;
        config.check()?;
        Ok(config)
    }
}

/// Trains, scores and writes the run directory.
///
/// # Errors
/// Whatever keeps the run from its end, in one line.
pub fn run(args: &TrainArgs) -> Result<()> {
    let config = args.options.config(args.dataset.clone())?;
    let gpu = Gpu::new(&config.device.parse::<DeviceChoice>()?)?;
    let dataset = Dataset::load(&config.dataset, &config.load_options())?;
    let mut directory = RunDirectory::create(&args.out, &config, args.overwrite)?;
    let (scored, seconds, gaussians) =
        train(&gpu, &config, &dataset, |report| directory.log(report)).and_then(|trained| {
            directory.save_model(&trained.gaussians)?;
            Ok((trained.scored, trained.seconds, trained.gaussians.count))
        })?;
    directory.save_metrics(&eval::metrics(&scored, seconds, gaussians, config.steps))?;
    let mut out = std::io::stdout().lock();
    if let Some(line) = summary(&scored) {
        writeln!(out, "{line}")?;
    }
    writeln!(
        out,
        "{} steps, {gaussians} Gaussians, {seconds:.0} s -> {}",
        config.steps,
        args.out.display()
    )?;
    Ok(())
}

/// What a training run made.
pub(crate) struct Trained {
    pub(crate) gaussians: crate::scene::Gaussians,
    pub(crate) scored: Vec<ViewScore>,
    /// Of the steps alone, without loading and scoring.
    pub(crate) seconds: f64,
}

/// Trains to the end, with a progress bar; `log` sees every step.
pub(crate) fn train(
    gpu: &Gpu,
    config: &TrainConfig,
    dataset: &Dataset,
    mut log: impl FnMut(&crate::train::StepReport) -> crate::Result<()>,
) -> crate::Result<Trained> {
    let mut trainer = Trainer::new(gpu, config.clone(), dataset)?;
    let bar = progress_bar(config.steps);
    let mut seconds = Duration::ZERO;
    while trainer.steps_done() < config.steps {
        let every = config.eval_every.max(1);
        let next_eval = (trainer.steps_done() / every + 1) * every;
        let until = if config.eval_every == 0 { config.steps } else { next_eval };
        let begin = Instant::now();
        let reports = trainer.advance(until)?;
        seconds += begin.elapsed();
        for report in &reports {
            log(report)?;
        }
        if let Some(last) = reports.last() {
            bar.set_position(last.step);
            bar.set_message(format!("loss {:.4}  {} Gaussians", last.loss, last.gaussians));
        }
        if config.eval_every > 0 && trainer.steps_done() == next_eval && next_eval < config.steps {
            let scored = eval::score(dataset, |view| trainer.render(&view.camera))?;
            if let Some(line) = summary(&scored) {
                bar.suspend(|| tracing::info!("step {next_eval}: {line}"));
            }
        }
    }
    bar.finish_and_clear();
    let scored = eval::score(dataset, |view| trainer.render(&view.camera))?;
    Ok(Trained { gaussians: trainer.gaussians()?, scored, seconds: seconds.as_secs_f64() })
}

/// The mean scores in a line; none where nothing was scored.
pub(crate) fn summary(scored: &[ViewScore]) -> Option<String> {
    let all: Vec<Scores> = scored.iter().map(|view| view.scores).collect();
    let mean = Scores::mean(&all)?;
    Some(format!(
        "{} test views: PSNR {:.2} dB (channel mean {:.2}), SSIM {:.3}",
        all.len(),
        mean.psnr,
        mean.psnr_channel_mean,
        mean.ssim
    ))
}

/// Step, loss, Gaussians, steps per second and time left; nothing where stderr is no terminal.
fn progress_bar(steps: u64) -> ProgressBar {
    let bar = ProgressBar::new(steps);
    if !std::io::stderr().is_terminal() {
        bar.set_draw_target(ProgressDrawTarget::hidden());
    }
    let template = "{bar:32} {pos}/{len}  {msg}  {per_sec}  {eta} left";
    if let Ok(style) = ProgressStyle::with_template(template) {
        bar.set_style(style);
    }
    bar
}
