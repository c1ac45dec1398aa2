//! `nightsplat train`: dark photographs in, a run directory out.

mod facts;
mod options;

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Result;

use self::facts::Facts;
pub(crate) use self::options::TrainOptions;
use super::diagnose;
use super::progress::{ProgressForm, Reporter, summary};
use super::signals;
use crate::base::output::printable;
use crate::gpu::{DeviceChoice, Gpu};
use crate::results::eval;
use crate::results::run::{self, IfExists, RunDirectory, RunSummary, Session};
use crate::train::diagnose::Plan;
use crate::train::{Origin, PlanSource, PlannedRun, RequestedSettings};

/// Train a 3D Gaussian Splatting model from dark photographs.
///
/// Each photograph is lifted by a tone curve into the pseudo-GT that supervises training; normal-light reference images,
/// where the dataset has them, are only ever used for scores. What the model has is decided by looking at the photographs
/// first (`nightsplat diagnose`), and said; any option wins over that. With --config, or a preset that states it all
/// (paper, or a benchmark's), nothing is decided.
///
/// SIGINT and SIGTERM save and stop, with exit code 130 or 143, and a second one ends the process at once; SIGUSR1 saves and
/// goes on. --resume goes on from there to the same bits; where the run is done it does nothing and succeeds.
#[derive(Clone, Debug, clap::Args)]
pub struct TrainArgs {
    /// The dataset: a folder with transforms*.json (LOM, RealX3D, NeRF) or a COLMAP model in sparse/, as `nightsplat pose` makes one
    pub dataset: PathBuf,
    /// The run directory to write: config.toml, model.ply, the networks, train.csv, evals.csv, a checkpoint, metrics.json
    #[arg(long, value_name = "RUN")]
    pub out: PathBuf,
    /// Replace the run that RUN already holds
    #[arg(long)]
    pub overwrite: bool,
    /// Go on from the checkpoint in RUN, or begin where there is none; the model gets the same bits as in one go. Give the options that the run began with; --steps may be more, --max-gaussians less, and what is logged another
    #[arg(long, conflicts_with = "overwrite")]
    pub resume: bool,
    /// The plan that `nightsplat diagnose --plan` wrote, in place of a diagnosis now; none: no plan, the defaults
    #[arg(long, value_name = "FILE|none")]
    pub plan: Option<PathBuf>,
    /// How to say what the run does [default: a bar on a terminal, else plain]
    #[arg(long, value_enum, value_name = "FORM")]
    pub progress: Option<ProgressForm>,
    /// Print every setting with its value, who says it and what it does, and train nothing
    #[arg(long)]
    pub explain: bool,
    #[command(flatten)]
    pub(crate) options: TrainOptions,
}

/// Trains, scores and writes the run directory.
///
/// # Errors
/// Whatever keeps the run from its end, in one line.
pub fn run(args: &TrainArgs) -> Result<()> {
    let mut requested = args.options.requested(&args.dataset)?;
    requested.settings(None)?.config()?.check()?;
    match args.resume {
        true => RunDirectory::check_resumed(&args.out)?,
        false => RunDirectory::check(&args.out, args.overwrite)?,
    }
    let is_resumed = args.resume && args.out.join("config.toml").is_file();
    if is_resumed && args.options.gives("steps") {
        // The views that it began with stay held out.
        let views = i64::try_from(run::load_config(&args.out)?.stop.views)?;
        requested.options.push("stop.views", views.into(), Origin::Run)?;
    }
    let given = args.plan.clone().filter(|path| path != Path::new("none"));
    let file = given.or_else(|| run::plan_of(&args.out).filter(|_| is_resumed));
    if is_resumed
        && !args.explain
        && let Some(steps) = done_by_stamp(args, &requested, file.as_deref())?
    {
        return print_done(args, steps);
    }
    let device = requested.settings(None)?.config()?.device;
    let gpu = Gpu::new(&device.parse::<DeviceChoice>()?)?;
    let planning = planning(args, file.as_deref(), is_resumed);
    let PlannedRun { config, settings, plan, dataset } = requested.planned(planning, &gpu)?;
    if args.explain {
        return Ok(write!(std::io::stdout(), "{}", printable(&settings.explained(&config)?))?);
    }
    for line in args.options.idle(&config) {
        tracing::warn!("{line}");
    }
    let finished = if args.resume { run::done_steps(&args.out, &config, &dataset)? } else { None };
    if let Some(steps) = finished {
        return print_done(args, steps);
    }
    let form = args.progress.unwrap_or_else(ProgressForm::of_terminal);
    let is_text = form != ProgressForm::Json;
    let mut out = std::io::stdout();
    let facts = Facts::of(&gpu, &config, plan.as_ref(), &dataset);
    if is_text {
        write!(
            out,
            "{}{}",
            facts.text(),
            plan.as_ref().map(diagnose::decisions).unwrap_or_default()
        )?;
    }
    let if_exists =
        if args.resume { IfExists::Resume } else { overwrite_or_refuse(args.overwrite) };
    let mut progress = Reporter::new(form).with_facts(serde_json::json!(facts));
    let session = Session {
        plan: plan.as_ref(),
        settings: Some(&settings),
        if_exists,
        requests: signals::requests()?,
    };
    let RunSummary { trainer, ended, scored, spent, .. } =
        run::train_in(&gpu, &config, &dataset, &args.out, &session, |event| {
            progress.observe(event);
        })?;
    if !is_text {
        return Ok(());
    }
    let gaussians = trainer.gaussian_count();
    writeln!(out, "{ended}")?;
    if let Some(line) = summary(&scored) {
        writeln!(out, "{line}")?;
    }
    if let Some(known) = config.tone.knows_references() {
        writeln!(out, "{}", eval::with_reference(&known))?;
    }
    if let Some(label) = eval::label(&scored) {
        writeln!(out, "the scores are {label}")?;
    }
    writeln!(
        out,
        "{} steps, {gaussians} Gaussians, {:.0} s -> {}",
        trainer.steps_done(),
        spent.seconds,
        args.out.display()
    )?;
    Ok(())
}

fn print_done(args: &TrainArgs, steps: u64) -> Result<()> {
    let done = format!("{} is done: {steps} steps", args.out.display());
    Ok(writeln!(std::io::stdout(), "{}", printable(&done))?)
}

/// The steps of the run that is to go on, if it is done and the files of its dataset are as they were: nothing is decoded for
/// that.
fn done_by_stamp(
    args: &TrainArgs,
    requested: &RequestedSettings,
    file: Option<&Path>,
) -> crate::Result<Option<u64>> {
    let plan = file.map(Plan::read).transpose()?;
    run::done_steps_by_stamp(&args.out, &requested.settings(plan.as_ref())?.config()?)
}

/// What decides what no option says: a plan where one is named, a run keeps to, or the photographs ask for.
fn planning<'a>(args: &TrainArgs, file: Option<&'a Path>, is_resumed: bool) -> PlanSource<'a> {
    match file {
        Some(file) => PlanSource::File(file),
        None if args.plan.is_none() && !is_resumed && args.options.wants_a_plan() => {
            PlanSource::Diagnosis
        }
        None => PlanSource::Nothing,
    }
}

/// What `--overwrite` says.
fn overwrite_or_refuse(overwrite: bool) -> IfExists {
    if overwrite { IfExists::Replace } else { IfExists::Refuse }
}
