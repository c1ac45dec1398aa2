//! `nightsplat train`: dark photographs in, a run directory out.

mod options;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Result;
use nightsplat_core::camera::frame;
use nightsplat_core::output::{check_apart, one_line, printable};
use nightsplat_photographs::tree::check_writable;

pub(crate) use self::options::TrainOptions;
use super::diagnose;
use super::progress::{ProgressForm, Reporter};
use super::tell::wrapped;
use super::{finish, phases, print, signals, stopped, tell, view, word};
use crate::Error;
use crate::driver;
use crate::gpu::DeviceChoice;
use crate::live;
use crate::results::run::{self, Event, IfExists, Requests, RunDirectory, RunSummary, Session};
use crate::results::run_facts::RunFacts;
use crate::results::{eval, verdict};
use crate::train::plan::Plan;
use crate::train::{Origin, PlanSource, PlannedRun, RequestedSettings};

/// Train a 3D Gaussian Splatting model from dark photographs.
///
/// A tone curve turns each photograph into a pseudo-GT, which supervises training. Reference images in normal light
/// are used for scores only. Before training, the photographs are measured as in `nightsplat diagnose`, and the model
/// is chosen from that; options override it. With --config, or a preset that states every setting (paper and the
/// benchmarks), nothing is chosen.
///
/// SIGINT, SIGTERM and SIGHUP save a checkpoint and stop, with exit code 130, 143 or 129; another a second later or
/// more ends the process at once. Under nohup, SIGHUP does nothing. SIGUSR1 saves a checkpoint and continues, SIGUSR2
/// lets the run cool down from there, and scores and writes it. --resume continues a run to the same bits; on a
/// finished run it does nothing.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = EXAMPLE)]
pub struct TrainArgs {
    /// Dataset: a folder with transforms*.json (LOM, RealX3D, NeRF) or a COLMAP model, such as `nightsplat pose` writes
    pub dataset: PathBuf,
    /// Run directory to write: model.ply, config.toml, metrics.json, train.csv, checkpoints
    #[arg(long, value_name = "RUN")]
    pub out: PathBuf,
    /// Replace an existing run
    #[arg(long)]
    pub overwrite: bool,
    /// Continue from the checkpoint in RUN, or start if there is none
    ///
    /// Continue from the checkpoint in RUN, or start if there is none; the model gets the same bits as without
    /// interruption. Repeat the options of the run: only --steps may grow, --max-gaussians shrink, and logging
    /// change.
    #[arg(long, conflicts_with = "overwrite")]
    pub resume: bool,
    /// With --resume: good enough; cool down from the checkpoint, score and write, instead of training to the last step
    #[arg(long, requires = "resume")]
    pub finish: bool,
    /// Plan that `nightsplat diagnose --plan` wrote; none: defaults [default: diagnose the photographs]
    #[arg(long, value_name = "FILE|none")]
    pub plan: Option<PathBuf>,
    /// Progress output [default: a bar on a terminal, else plain]
    #[arg(long, value_enum, value_name = "FORM")]
    pub progress: Option<ProgressForm>,
    /// Serve a live page of the run on this address [default with the option: 127.0.0.1:7007]
    ///
    /// Serve a live page of the run: the model as it trains, photographs and targets, progress; it can pause, save and
    /// stop. On another machine, forward the port: ssh -L 7007:127.0.0.1:7007 HOST. Watching changes no bit of the
    /// model.
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = live::DEFAULT_ADDRESS)]
    pub view: Option<live::Listen>,
    /// Print every setting, its value and where that comes from; do not train
    #[arg(long)]
    pub explain: bool,
    #[command(flatten)]
    pub(crate) options: TrainOptions,
    /// Begins every line of progress, where training is one of several stages.
    #[arg(skip)]
    pub prefix: String,
}

const EXAMPLE: &str = "Example:
  nightsplat train photos --out run --preset fast --max-vram 4G";

/// Trains, scores and writes the run directory; `everything`: prints also what the plan leaves off.
pub fn run(args: &TrainArgs, everything: bool) -> Result<()> {
    if let Some(wrote) = train(args, everything, None)? {
        finish(&wrote, &next(args));
    }
    Ok(())
}

/// Trains, scores and writes the run directory; the requests are by default those of signals. Returns what was written,
/// unless only JSON or an explanation is wanted.
pub(super) fn train(
    args: &TrainArgs,
    everything: bool,
    requests: Option<&Requests>,
) -> Result<Option<String>> {
    let mut requested = args.options.requested(&args.dataset)?;
    requested.settings(None)?.config()?.check()?;
    check_writable(&args.out)?;
    let is_resumed = args.resume && args.out.join("config.toml").is_file();
    if !is_resumed {
        check_apart(&args.out, &args.dataset, true)?;
    }
    match args.resume {
        true => RunDirectory::check_resumed(&args.out)?,
        false => RunDirectory::check(&args.out, args.overwrite)?,
    }
    if args.finish && !run::has_checkpoint(&args.out) {
        let problem = "has no checkpoint to finish from; train it first";
        return Err(Error::input(&args.out, problem).into());
    }
    if is_resumed && args.options.gives("steps") {
        // The held-out views of the run stay held out.
        let views = i64::try_from(run::load_config(&args.out)?.stop.views)?;
        requested.options.push("stop.views", views.into(), Origin::Run)?;
    }
    let given = args.plan.clone().filter(|path| path != Path::new("none"));
    let file = given.or_else(|| run::plan_of(&args.out).filter(|_| is_resumed));
    if is_resumed
        && !args.explain
        && let Some(steps) = done_by_stamp(args, &requested, file.as_deref())?
    {
        return Ok(Some(done(args, steps)));
    }
    let device = requested.settings(None)?.config()?.device;
    let choice = device.parse::<DeviceChoice>()?;
    let gpu = driver::open(&choice)?;
    let planning = planning(args, file.as_deref(), is_resumed);
    let PlannedRun { config, settings, plan, dataset } = requested.planned(planning, &gpu)?;
    if args.explain {
        print(printable(&settings.explained(&config)?))?;
        return Ok(None);
    }
    for line in args.options.idle(&config) {
        tracing::warn!("{line}");
    }
    let finished = if args.resume { run::done_steps(&args.out, &config, &dataset)? } else { None };
    if let Some(steps) = finished {
        return Ok(Some(done(args, steps)));
    }
    let form = args.progress.unwrap_or_else(ProgressForm::of_terminal);
    let (is_text, is_quiet) = (form != ProgressForm::Json, form == ProgressForm::None);
    let facts = RunFacts::new(&gpu, &config, plan.as_ref(), &dataset);
    if is_text && !is_quiet {
        let plan = plan.as_ref().map(|plan| diagnose::decisions(plan, everything));
        let lines = facts.text();
        let facts: String = lines.lines().map(|line| wrapped(line, 0)).collect();
        tell(facts + &plan.unwrap_or_default());
    }
    let if_exists =
        if args.resume { IfExists::Resume } else { overwrite_or_refuse(args.overwrite) };
    let mut progress = Reporter::new(form, &args.prefix).with_facts(serde_json::json!(facts));
    let requests = requests.map_or_else(signals::requests, |requests| Ok(requests.clone()))?;
    if args.finish {
        requests.finish();
    }
    let dataset = Arc::new(dataset);
    let page = args
        .view
        .map(|listen| view::of_training(listen, &args.out, &config, &dataset, &gpu, &requests));
    let page = page.transpose()?;
    let session = Session {
        plan: plan.as_ref(),
        settings: Some(&settings),
        if_exists,
        requests: requests.clone(),
    };
    let observe = |event: Event<'_>| {
        progress.observe(event);
        if let Some((site, _)) = &page {
            site.feed.observe(event);
        }
    };
    let done = run::train_in(&gpu, &config, &dataset, &args.out, &session, observe);
    if let Some((site, _)) = &page {
        site.feed.end(&ended_on_page(args, &done));
    }
    let done = done?;
    let RunSummary { trainer, ended, evaluation, spent, .. } = done;
    phases::log();
    if !is_text {
        return Ok(None);
    }
    let gaussians = trainer.gaussian_count();
    tell(ended);
    if let Some(sentence) = verdict::of_model(&evaluation) {
        tell(wrapped(&sentence, 0));
    }
    if let Some(reference_settings) = config.tone.knows_references() {
        tell(eval::with_reference(&reference_settings));
    }
    let (steps, seconds) = (trainer.steps_done(), spent.seconds);
    tell(format_args!("{steps} steps, {gaussians} Gaussians, {seconds:.0} s"));
    let frame = run::load_config(&args.out)?.frame.unwrap_or_default();
    if let Some(line) = frame::relative_to(frame.file_origin()) {
        tell(format_args!("model.ply: {line}"));
    }
    let run = args.out.display();
    Ok(Some(format!("{run}/model.ply, {run}/metrics.json")))
}

/// How the run ended, as its page says it.
fn ended_on_page<T>(args: &TrainArgs, done: &crate::Result<T>) -> String {
    let run = word(&args.out);
    match done {
        Ok(_) => format!("finished, saved; next: nightsplat export {run} --format html"),
        Err(Error::Stopped { step, cause, .. }) => stopped::stopped(*step, *cause),
        Err(error) => format!("ended: {error}"),
    }
}

/// The command to run after training.
fn next(args: &TrainArgs) -> String {
    let run = word(&args.out);
    format!("nightsplat export {run} --format html  (then open {run}/model.html)")
}

/// Tells that nothing is left to do, and that nothing was written.
fn done(args: &TrainArgs, steps: u64) -> String {
    let done = format!("{} is done: {steps} steps", args.out.display());
    tell(one_line(&done));
    String::new()
}

/// The step count of the run to resume if it is finished and the files of its dataset are unchanged. Decodes nothing.
fn done_by_stamp(
    args: &TrainArgs,
    requested: &RequestedSettings,
    file: Option<&Path>,
) -> crate::Result<Option<u64>> {
    let plan = file.map(Plan::read).transpose()?;
    run::done_steps_by_stamp(&args.out, &requested.settings(plan.as_ref())?.config()?)
}

/// Where settings that no option gives come from: a plan file, a diagnosis, or the defaults.
fn planning<'a>(args: &TrainArgs, file: Option<&'a Path>, is_resumed: bool) -> PlanSource<'a> {
    match file {
        Some(file) => PlanSource::File(file),
        None if args.plan.is_none() && !is_resumed && args.options.wants_a_plan() => {
            PlanSource::Diagnosis
        }
        None => PlanSource::Nothing,
    }
}

/// The effect of `--overwrite`.
fn overwrite_or_refuse(overwrite: bool) -> IfExists {
    if overwrite { IfExists::Replace } else { IfExists::Refuse }
}
