//! `nightsplat sweep`: train over a grid of settings, and rank what comes out.
//!
//! ```text
//! OUT/sweep.toml        what is swept here; another sweep needs another folder
//!     NAME/             a run directory per point, with log.txt beside what `train` writes
//!     leaderboard.csv   a row per point, seeds averaged; .md the same
//!     timings.csv       seconds per point
//!     index.html        the leaderboard with plots
//! ```
//!
//! Nothing but `timings.csv` depends on how fast a point was trained, or on how often the sweep was interrupted.

mod grid;
mod leaderboard;

use std::io::Write;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use serde::Serialize;

use self::grid::PaperTable;
use self::leaderboard::Leaderboard;
use super::batch::options::{Lists, Options};
use super::batch::point::{ADAPTIVE, Axis, OFFSET};
use super::batch::{self, Common, Run, absolute, runner};
use super::progress_bar;
use crate::Error;
use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::Dataset;
use crate::photographs::tone::Statistics;
use crate::train::TrainConfig;

/// Train over a grid of settings, each point in its own run directory, and rank the results.
///
/// A point is one `nightsplat train` command, run as a process of its own. Interrupt the sweep at any time and give the
/// same command again: finished points stay, those under way go on from what they saved. A point that fails is reported, and the
/// others go on. More values may join a list later; another base or another set of lists needs another --out.
#[derive(Clone, Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct SweepArgs {
    /// The dataset, as for `train`
    pub dataset: PathBuf,
    /// The folder of the sweep: a run directory per point, leaderboard.csv, leaderboard.md, index.html
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Trainings at once; they share the device
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    pub jobs: u16,
    /// Print the command line of every point that is left, and train nothing
    #[arg(long)]
    pub dry_run: bool,
    /// The grid of one of the paper's tables; the lists below replace its own or add to them
    #[arg(long, value_enum, help_heading = "The grid")]
    table: Option<PaperTable>,
    /// Values of alpha, the highest black level
    #[arg(long, value_name = "LIST", help_heading = "The grid")]
    alpha: Option<String>,
    /// Values of beta: how fast the black level falls as the shadows are less crushed
    #[arg(long, value_name = "LIST", help_heading = "The grid")]
    beta: Option<String>,
    /// Fixed black levels delta0, and `adaptive` for that of alpha and beta
    #[arg(long, value_name = "LIST", help_heading = "The grid")]
    offset: Option<String>,
    /// Values of any setting by its place in config.toml, such as `density.min_opacity=0.005,0.01`; may be repeated
    #[arg(long, value_name = "KEY=LIST", help_heading = "The grid")]
    grid: Vec<String>,
    #[command(flatten, next_help_heading = "What every point is trained with")]
    options: Options<SweepLists>,
}

const EXAMPLES: &str = "A LIST is comma-separated. Examples:
  nightsplat sweep photos --out sweep --curves all --downscale 4 --steps 300
  nightsplat sweep photos --out offsets --table offset --seeds 1,2,3
  nightsplat sweep photos --out density --grid density.gradient_threshold=1e-4,2e-4 --jobs 2";

/// What a sweep takes as lists.
#[derive(Clone, Copy, Debug)]
struct SweepLists;

impl Lists for SweepLists {
    const LISTS: &'static [(&'static str, &'static str, &'static str)] = &[
        ("curve", "curves", "Tone curves by name or file, or `all` [default: {tone.curve}]"),
        (
            "gain",
            "gain",
            "Values of c: how much a brighter photograph raises the curve's gain, or auto",
        ),
        ("theta", "theta", "Means that the linear curve aims at"),
        (
            "seed",
            "seeds",
            "Seeds; the leaderboard has the mean over them, and their standard deviation",
        ),
    ];
}

/// Trains what is left of the grid and writes the leaderboard.
///
/// # Errors
/// A grid, an option or a dataset that makes no sense, before anything is trained; a folder that holds another sweep;
/// points that failed, after the others are finished.
pub fn run(args: &SweepArgs) -> Result<()> {
    let runs = plan(args)?;
    let mut left = vec![];
    for run in &runs {
        if !run.is_finished()? {
            left.push(run);
        }
    }
    let first = &runs[0].config;
    let dataset = Dataset::load(&first.dataset, &first.load_options())?;
    if !args.dry_run && !left.is_empty() {
        open(first)?;
    }
    batch::claim(&args.out, "sweep", &manifest(args, &runs)?, &leaderboard::FILES, !args.dry_run)?;
    let mut out = std::io::stdout().lock();
    if args.dry_run {
        for run in left {
            writeln!(out, "{}", run.command_line()?)?;
        }
        return Ok(());
    }
    let bar = progress_bar(left.len());
    let failures = runner::train(&left, args.jobs.into(), &bar, (&args.out, runs.len()))?;

    let baseline = args.table.and_then(PaperTable::baseline);
    let shared = &args.options.shared;
    let leaderboard = Leaderboard::new(&runs, baseline, adaptive_offset(&runs, &dataset), shared);
    // Scores do not need the device that the runs had; pictures do.
    let pictures = match open(first) {
        Ok(gpu) => leaderboard.pictures(&runs, &dataset, &gpu)?,
        Err(problem) => {
            tracing::warn!("{}: no pictures: {problem}", args.out.display());
            None
        }
    };
    leaderboard.save(&args.out, &failures, pictures)?;
    writeln!(
        out,
        "{}{}",
        super::table::of(&leaderboard.table()),
        args.out.join("index.html").display()
    )?;
    if let Some(failure) = failures.first() {
        let (failed, all) = (failures.len(), runs.len());
        anyhow::bail!("{failed} of {all} points failed; the first: {}", failure.reason);
    }
    Ok(())
}

fn open(config: &TrainConfig) -> crate::Result<Gpu> {
    Gpu::new(&config.device.parse::<DeviceChoice>()?)
}

/// The points of the grid, each checked as `train` would.
fn plan(args: &SweepArgs) -> crate::Result<Vec<Run>> {
    let lists = [("alpha", &args.alpha), ("beta", &args.beta), (OFFSET, &args.offset)];
    let mut axes = vec![];
    for (key, list) in lists {
        axes.extend(list.as_deref().map(|list| Axis::new(key, list)).transpose()?);
    }
    for (key, list) in &args.options.lists {
        axes.push(Axis::new(key, list)?);
    }
    for list in &args.grid {
        axes.push(Axis::parse("grid", list)?);
    }
    let points = grid::points(&axes, args.table)?;
    let (dataset, out) = (absolute(&args.dataset)?, absolute(&args.out)?);
    let common = Common { dataset: &dataset, shared: &args.options.shared, out: &out };
    let mut runs: Vec<Run> = vec![];
    for point in points {
        // Points are to differ by what the grid says alone: no plan.
        let run = Run::new(point, common, None)?;
        if let Some(other) = runs.iter().find(|other| other.config == run.config) {
            let problem =
                format!("{} and {} are the same run; leave one out", other.name, run.name);
            return Err(Error::Usage(problem));
        }
        runs.push(run);
    }
    Ok(runs)
}

/// What `sweep.toml` says: the sweep without the values of its lists.
fn manifest(args: &SweepArgs, runs: &[Run]) -> crate::Result<String> {
    #[derive(Serialize)]
    struct Manifest<'a> {
        dataset: String,
        train: &'a [String],
        lists: Vec<&'a str>,
    }
    let keys = runs.iter().flat_map(|run| &run.point.values).map(|(key, _)| key.as_str());
    let mut lists: Vec<&str> = keys.collect();
    lists.sort_unstable();
    lists.dedup();
    let manifest =
        Manifest { dataset: absolute(&args.dataset)?, train: &args.options.shared, lists };
    toml::to_string(&manifest).map_err(|error| Error::Usage(error.to_string()))
}

/// delta0, the mean over the training views, where the sweep has the adaptive black level.
fn adaptive_offset(runs: &[Run], dataset: &Dataset) -> Option<f64> {
    let run = runs.iter().find(|run| run.point.value(OFFSET) == Some(ADAPTIVE))?;
    // Those that can be read: what cannot is said where it is trained on.
    let images = dataset.train_views().filter_map(|view| view.loaded().ok().flatten());
    let offsets: Vec<f64> =
        images.map(|image| run.config.tone.offset(Statistics::of(&image.data).ratio())).collect();
    Some(offsets.iter().sum::<f64>() / offsets.len() as f64)
}
