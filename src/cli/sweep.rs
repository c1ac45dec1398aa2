//! `nightsplat sweep`: train over a grid of settings, and rank what comes out.
//!
//! ```text
//! OUT/sweep.toml        what is swept here; another sweep needs another folder
//!     NAME/             a run directory per point, with log.txt beside what `train` writes
//!     leaderboard.csv   a row per point, seeds averaged; .md the same
//!     index.html        the leaderboard with plots and pictures
//!     costs.csv         time, energy and memory of each point
//!     costs.html        scores against them, with fronts
//! ```
//!
//! Nothing but the costs depends on how fast a point was trained, or on how often the sweep was interrupted.

mod costs;
mod grid;
mod leaderboard;
mod options;
mod point;
mod rows;
mod run;
mod runner;

use std::io::Write;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use serde::Serialize;

use self::grid::Grid;
use self::leaderboard::Leaderboard;
use self::options::Options;
use self::point::{ADAPTIVE, Axis, OFFSET, PARTS};
use self::rows::Rows;
pub(super) use self::run::parsed;
use self::run::{Common, Run, absolute, difference};
use super::progress_bar;
use crate::Error;
use crate::base::input;
use crate::base::output::write_whole;
use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::Dataset;
use crate::photographs::tone::Statistics;
use crate::train::{Part, TrainConfig, diagnosed};

/// Train over a grid of settings, each point in its own run directory, and rank the results.
///
/// A point is one `nightsplat train` command, run as a process of its own. Interrupt the sweep at any time and give the
/// same command again: finished points stay, those under way go on from what they saved. A point that fails is reported, and the
/// others go on. More values may join a list later; another base or another set of lists needs another --out.
///
/// OUT/index.html ranks the points, OUT/costs.html draws their scores against time, energy and memory, and with --eval-every how
/// each came there.
#[derive(Clone, Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct SweepArgs {
    /// The dataset, as for `train`
    pub dataset: PathBuf,
    /// The folder of the sweep: a run directory per point, index.html, leaderboard.csv, leaderboard.md, costs.html, costs.csv
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Trainings at once; they share the device
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    pub jobs: u16,
    /// Print the command line of every point that is left, and train nothing
    #[arg(long)]
    pub dry_run: bool,
    /// Print every figure as JSON instead of tables
    #[arg(long)]
    pub json: bool,
    /// A grid that has a name; the lists below replace its own or add to them
    #[arg(long, value_enum, help_heading = "The grid")]
    table: Option<Grid>,
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
    options: Options,
}

const EXAMPLES: &str = "A LIST is comma-separated. Examples:
  nightsplat sweep photos --out sweep --curves all --downscale 4 --steps 300
  nightsplat sweep photos --out parts --table parts --seeds 1,2,3
  nightsplat sweep photos --out presets --table presets --eval-every 50
  nightsplat sweep photos --out density --grid density.gradient_threshold=1e-4,2e-4 --jobs 2";

/// Trains what is left of the grid and writes what it found.
///
/// # Errors
/// A grid, an option or a dataset that makes no sense, before anything is trained; a folder that holds another sweep;
/// points that failed, after the others are finished.
pub fn run(args: &SweepArgs) -> Result<()> {
    let dataset = args.dataset.display();
    run_titled(args, &format!("Sweep of {dataset}"), &[])
}

/// The same with a title and first paragraphs of the page.
pub(super) fn run_titled(args: &SweepArgs, title: &str, intro: &[String]) -> Result<()> {
    let (runs, dataset) = plan(args)?;
    let mut left = vec![];
    for run in &runs {
        if !run.is_finished()? {
            left.push(run);
        }
    }
    let first = &runs[0].config;
    if !args.dry_run && !left.is_empty() {
        open(first)?;
    }
    claim(args, &runs)?;
    let mut out = std::io::stdout().lock();
    if args.dry_run {
        for run in left {
            writeln!(out, "{}", run.command_line()?)?;
        }
        return Ok(());
    }
    let bar = progress_bar(left.len());
    let failures = runner::train(&left, args.jobs.into(), &bar, (&args.out, runs.len()))?;

    let rows = Rows::new(&runs, args.table.and_then(Grid::baseline));
    let settings = settings(&runs, &rows.seeds, &args.options.shared);
    let leaderboard = Leaderboard {
        rows: &rows,
        title: title.to_owned(),
        intro: intro.iter().cloned().chain([settings]).collect(),
        adaptive_offset: adaptive_offset(&runs, &dataset),
        failures: &failures,
    };
    // Scores do not need the device that the runs had; pictures do.
    let pictures = match open(first) {
        Ok(gpu) => leaderboard.pictures(&runs, &dataset, &gpu)?,
        Err(problem) => {
            tracing::warn!("{}: no pictures: {problem}", args.out.display());
            None
        }
    };
    leaderboard.save(&args.out, pictures)?;
    rows.save_costs(&args.out, title, &leaderboard.notes())?;
    if args.json {
        writeln!(out, "{:#}", rows.json(&dataset.root, &failures))?;
    } else {
        let tables = [leaderboard.table(), rows.costs()].map(|table| super::table::of(&table));
        writeln!(out, "{}\n{}", tables.join("\n"), args.out.join("index.html").display())?;
    }
    if let Some(failure) = failures.first() {
        let (failed, all) = (failures.len(), runs.len());
        anyhow::bail!("{failed} of {all} points failed; the first: {}", failure.reason);
    }
    Ok(())
}

fn open(config: &TrainConfig) -> crate::Result<Gpu> {
    Gpu::new(&config.device.parse::<DeviceChoice>()?)
}

/// The points of the grid, each checked as `train` would, and their dataset.
fn plan(args: &SweepArgs) -> crate::Result<(Vec<Run>, Dataset)> {
    let lists = [("alpha", &args.alpha), ("beta", &args.beta), (OFFSET, &args.offset)];
    let mut axes = vec![];
    for (key, list) in lists {
        axes.extend(list.as_deref().map(|list| Axis::new(key, list)).transpose()?);
    }
    for (key, list) in &args.options.lists {
        axes.push(Axis::new(key, list)?);
    }
    for list in &args.grid {
        axes.push(Axis::parse(list)?);
    }
    let shared = &args.options.shared;
    if args.table == Some(Grid::Parts) && shared.iter().any(|it| it == "--model" || it == "--parts")
    {
        let problem = "--table parts trains every part by itself; leave out --model and --parts \
                       (lita's L1 alone is --ssim-weight 0)";
        return Err(Error::Usage(problem.to_owned()));
    }
    let points = grid::points(&axes, args.table)?;
    let (dataset, out) = (absolute(&args.dataset)?, absolute(&args.out)?);
    let common = Common { dataset: &dataset, shared, out: &out };
    let mut runs: Vec<Run> = vec![];
    for point in points {
        let run = Run::new(point, common)?;
        match runs.iter().find(|other| other.config == run.config) {
            None => runs.push(run),
            Some(other) if args.table.is_some() => {
                tracing::info!("{} is left out: it is the same run as {}", run.name, other.name);
            }
            Some(other) => {
                let (one, other) = (&other.name, &run.name);
                let problem = format!("{one} and {other} are the same run; leave one out");
                return Err(Error::Usage(problem));
            }
        }
    }
    let first = &runs[0].config;
    let dataset = Dataset::load(&first.dataset, &diagnosed(first))?;
    if !dataset.test_views().any(|view| view.has_reference() || view.has_photograph()) {
        let problem = "has no held-out view to score; list one in transforms_test.json or test.txt, or add photographs: \
                       of eight, one is held out";
        return Err(Error::input(&dataset.root, problem));
    }
    if !dataset.train_views().any(|view| view.depth.is_some()) {
        runs.retain(|run| run.point.value(PARTS) != Some(Part::Depth.name()));
    }
    Ok((runs, dataset))
}

/// Takes a folder that is empty, holds this sweep or holds nothing that a sweep would replace.
///
/// # Errors
/// The folder is taken, or cannot be written.
fn claim(args: &SweepArgs, runs: &[Run]) -> crate::Result<()> {
    let (folder, manifest) = (&args.out, manifest(args, runs)?);
    let path = folder.join("sweep.toml");
    if path.exists() {
        let found = input::text(&path)?;
        if found != manifest {
            let differs = difference(&found, &manifest);
            let problem = format!("holds another sweep ({differs}); choose another --out");
            return Err(Error::output(folder, problem));
        }
        return Ok(());
    }
    let files = leaderboard::FILES.iter().chain(&costs::FILES);
    if let Some(file) = files.into_iter().find(|file| folder.join(file).exists()) {
        let problem = format!("holds {file}, which no sweep wrote; choose another --out");
        return Err(Error::output(folder, problem));
    }
    if args.dry_run {
        return Ok(());
    }
    std::fs::create_dir_all(folder)
        .map_err(|error| Error::output(folder, format!("cannot be made: {error}")))?;
    write_whole(&path, manifest.as_bytes())
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

/// A sentence on what the runs are, and what all were given.
fn settings(runs: &[Run], seeds: &[String], shared: &[String]) -> String {
    let mut steps: Vec<u64> = runs.iter().map(|run| run.config.steps).collect();
    steps.sort_unstable();
    steps.dedup();
    let steps: Vec<String> = steps.iter().map(u64::to_string).collect();
    let mut text = format!("{} runs of {} steps", runs.len(), steps.join(" or "));
    if seeds.len() > 1 {
        let seeds = seeds.join(", ");
        text += &format!(
            "; scores are means over the seeds {seeds}, and bars their least and greatest"
        );
    }
    if !shared.is_empty() {
        text += &format!("; all with {}", shared.join(" "));
    }
    text + ". The folder of each run has its config.toml."
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
