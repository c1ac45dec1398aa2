//! `nightsplat blocks`: scenes that outgrow a device.

mod work;

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Subcommand;
use nightsplat_core::output::printable;
use nightsplat_core::table::aligned;
use nightsplat_photographs::tree::check_writable;

use self::work::work;
use super::train::TrainOptions;
use super::{finish, print, tell, word};
use crate::Error;
use crate::blocks::{self, BlockPlan, MAX_ROUNDS, PlanRow, Request};
use crate::driver;
use crate::gpu::DeviceChoice;
use crate::train::{CacheSize, PlanSource};

/// Train a scene that outgrows a device or a machine, in blocks.
///
/// `plan` measures the photographs once and cuts the scene into blocks, each of which trains as an ordinary run; `run`
/// trains them here, one after another; `join` joins them. Between plan and join, Snakemake, `HyperQueue`, Slurm or any
/// other engine may run the tasks: it reads tasks.jsonl, and nothing else (examples/schedulers). The joined model has
/// the same bytes for any number and order of workers, and after any interruption. The folder of a plan is
/// used like a run: `nightsplat eval CITY`, `render`, `export`, `view`.
#[derive(Clone, Debug, clap::Args)]
pub struct BlocksArgs {
    #[command(subcommand)]
    command: BlocksCommand,
}

#[derive(Clone, Debug, Subcommand)]
enum BlocksCommand {
    Plan(Box<PlanArgs>),
    Run(RunArgs),
    Join(JoinArgs),
}

/// Measure the photographs once, and cut the scene into blocks that fit the memory of a worker.
///
/// --steps counts the steps of all blocks together: an eighth is for a coarse model, from which every block starts, the
/// rest is shared by views. --max-gaussians counts the Gaussians of the whole scene.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:
  nightsplat blocks plan photos --out city --memory 8G --max-gaussians 20000000
  nightsplat blocks run city")]
pub struct PlanArgs {
    /// Dataset: a folder with transforms*.json or a COLMAP model
    pub dataset: PathBuf,
    /// Folder to write: plan.toml, law.toml, frame.toml, config.toml, tasks.jsonl, coarse and blocks
    #[arg(long, value_name = "CITY")]
    pub out: PathBuf,
    /// Memory of a worker, such as 8G [default: that of the device]
    #[arg(long, value_name = "SIZE")]
    pub memory: Option<CacheSize>,
    /// Number of blocks, in place of as many as the memory asks for
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(2..=9999))]
    pub blocks: Option<u16>,
    /// How often every block trains; from the second time on, beside its neighbours of the round before, to fit them
    #[arg(long, value_name = "N", default_value_t = 2,
        value_parser = clap::value_parser!(u8).range(1..=i64::from(MAX_ROUNDS)))]
    pub rounds: u8,
    /// Settings that `nightsplat diagnose --plan` wrote; none: defaults [default: diagnose the photographs]
    #[arg(long, value_name = "FILE|none")]
    pub plan: Option<PathBuf>,
    /// Print the plan, and write nothing
    #[arg(long)]
    pub dry_run: bool,
    /// Print the plan as JSON
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub(crate) options: TrainOptions,
}

/// Train the blocks of a plan on this machine, one after another, and join them.
///
/// What is done is not done again. A signal is passed on to the training under way, which saves; repeating the command
/// continues.
#[derive(Clone, Debug, clap::Args)]
pub struct RunArgs {
    /// Folder of the plan
    pub city: PathBuf,
}

/// Join the trained blocks of a plan into one model in tiles: model/manifest.json.
#[derive(Clone, Debug, clap::Args)]
pub struct JoinArgs {
    /// Folder of the plan
    pub city: PathBuf,
    /// Join the blocks of this round instead of the last
    #[arg(long, value_name = "N")]
    pub round: Option<u8>,
    /// Refuse blocks that were trained on several devices or drivers, whose bits may differ
    #[arg(long)]
    pub same_device: bool,
}

/// Plans, trains or joins.
pub fn run(args: &BlocksArgs) -> Result<()> {
    match &args.command {
        BlocksCommand::Plan(args) => plan(args),
        BlocksCommand::Run(args) => run_tasks(args),
        BlocksCommand::Join(args) => join(args),
    }
}

fn plan(args: &PlanArgs) -> Result<()> {
    check_writable(&args.out)?;
    let requested = args.options.requested(&args.dataset)?;
    let config = requested.settings(None)?.config()?;
    config.check()?;
    if config.tone.targets().is_some() {
        let problem = "blocks share a tone law, and targets of another program have none";
        return Err(Error::Usage(problem.to_owned()).into());
    }
    for (key, is_set) in [("init", config.init.is_some()), ("tone.law", config.tone.law.is_some())]
    {
        if is_set {
            let problem = format!("{key} is what a plan decides; leave it out");
            return Err(Error::Usage(problem).into());
        }
    }
    let gpu = driver::open(&config.device.parse::<DeviceChoice>()?)?;
    let planning = match args.plan.as_deref() {
        Some(file) if file != Path::new("none") => PlanSource::File(file),
        None if args.options.wants_a_plan() => PlanSource::Diagnosis,
        _ => PlanSource::Nothing,
    };
    let planned = requested.planned(planning, &gpu)?;
    let memory = match args.memory.or(config.max_vram) {
        Some(CacheSize(bytes)) => bytes,
        None => gpu.properties().memory,
    };
    let request = Request {
        memory,
        is_shared: gpu.properties().is_cpu,
        blocks: args.blocks.map(usize::from),
        rounds: args.rounds,
    };
    let plan = blocks::plan(&planned, &request)?;
    let (summary, json) = (summary(&plan), serde_json::json!(plan.file));
    let steps = plan.steps();
    let tasks = if args.dry_run { None } else { Some(plan.save(&args.out)?) };
    if args.json {
        return Ok(print(format_args!("{json:#}"))?);
    }
    // What a few views cannot train, such as black ones, is no reason to plan nothing.
    let hours = blocks::speed(&gpu, &planned)
        .map(|(milliseconds, gaussians)| hours(steps, milliseconds, gaussians));
    tell(printable(&summary).into_owned() + &hours.unwrap_or_default());
    let Some(tasks) = tasks else { return Ok(()) };
    let (city, count) = (args.out.display(), tasks.len());
    let wrote = format!("{city}/plan.toml, law.toml, frame.toml, and {count} tasks in tasks.jsonl");
    finish(&wrote, &format!("nightsplat blocks run {}", word(&args.out)));
    Ok(())
}

/// A table of the tasks, and their sums.
fn summary(plan: &BlockPlan) -> String {
    let mebibytes = |bytes: u64| (bytes >> 20).to_string();
    let row = |row: &PlanRow| {
        let numbers = [row.views, row.points, row.gaussians].map(|number| number.to_string());
        let [views, points, gaussians] = numbers;
        let (steps, memory, disk) =
            (row.steps.to_string(), mebibytes(row.memory), mebibytes(row.disk));
        vec![row.id.clone(), views, points, gaussians, steps, memory, disk]
    };
    let head = ["block", "views", "points", "Gaussians", "steps", "MiB", "MiB on disk"];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    rows.extend(std::iter::once(&plan.file.coarse).chain(&plan.file.blocks).map(row));
    let (table, count, percent) = (aligned(&rows), plan.file.round(1).count(), 100.0 * plan.shared);
    format!("{table}{count} blocks, each with {percent:.0} % of the views on average\n")
}

/// The time of all steps at the speed of those that were measured.
fn hours(steps: u64, milliseconds: f64, gaussians: usize) -> String {
    let hours = steps as f64 * milliseconds / 3.6e6;
    format!(
        "{steps} steps of {milliseconds:.1} ms, as measured here with {gaussians} Gaussians, take {hours:.2} h on one \
         worker; more Gaussians take longer\n"
    )
}

fn run_tasks(args: &RunArgs) -> Result<()> {
    work(&args.city, |task, [number, all], is_done| {
        let state = if is_done { " is done" } else { "" };
        let line = format!("[{number}/{all}] {}{state}", task.id);
        tell(line);
    })?;
    finish("", &next(&args.city));
    Ok(())
}

fn join(args: &JoinArgs) -> Result<()> {
    let joined = blocks::join(&args.city, args.round, args.same_device, |tile| {
        tracing::info!("{}: {} Gaussians", tile.file.display(), tile.count);
    })?;
    let (count, tiles) = (joined.manifest.count, joined.manifest.tiles.len());
    let (cropped, model) = (joined.cropped, &joined.manifest.folder);
    tell(format_args!(
        "{count} Gaussians in {tiles} tiles; {cropped} of the blocks lie outside their cores and are left out"
    ));
    finish(&model.join("manifest.json").display().to_string(), &next(&args.city));
    Ok(())
}

fn next(city: &Path) -> String {
    format!("nightsplat eval {}", word(city))
}
