//! `nightsplat sweep`: trains over a grid of settings, and ranks the results.
//!
//! ```text
//! OUT/sweep.toml        the sweep of this folder; another sweep needs another folder
//!     NAME/             the run directory of a point, with the output of `train` in log.txt
//!     leaderboard.csv   a row per point, seeds averaged; also as .md
//!     index.html        the leaderboard with plots and images
//!     costs.csv         time, energy and memory of each point
//!     costs.html        scores against these costs, with Pareto fronts
//! ```
//!
//! Only the costs depend on the speed of the device and on interruptions.

mod arguments;
mod grid;
mod options;
mod run;
mod runner;
mod scenes;
mod scores;

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;
use nightsplat_core::input;
use nightsplat_core::output::{create_folder, write_whole};
use nightsplat_photographs::dataset::{Dataset, View, ViewPictures};
use nightsplat_photographs::tone::Statistics;
use nightsplat_photographs::tree::check_writable;
use serde::Serialize;

use self::grid::Grid;
use self::options::Options;
pub(super) use self::run::parsed;
use self::run::{SweepTraining, absolute, difference};
use super::eval::LpipsRange;
use super::{finish, print, progress_bar, tell};
use crate::Error;
use crate::driver;
use crate::gpu::{DeviceChoice, Gpu};
use crate::results::comparison::NamedRenders;
use crate::results::sweep::{
    ADAPTIVE, COST_FILES, FailedPoint, LEADERBOARD_FILES, Leaderboard, OFFSET, PARTS, SweepAxis,
    SweepResults, SweepRun,
};
use crate::train::{Part, TrainConfig, diagnosed};

/// Train over a grid of settings, and rank the results.
///
/// Each point of the grid is one `nightsplat train` process. An interrupted sweep continues when the command is
/// repeated: finished points are kept, unfinished ones resume. A failed point is reported, and the others continue.
/// Lists may grow later; other lists or other common options need another --out.
///
/// OUT/index.html ranks the points; OUT/costs.html plots their scores against time, energy and memory.
#[derive(Clone, Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct SweepArgs {
    /// Dataset, as for `train`
    pub dataset: PathBuf,
    /// More datasets: each is swept in its own folder of OUT, and OUT/index.html and OUT/scenes.md have a column for
    /// each and their mean
    #[arg(value_name = "DATASET")]
    pub more: Vec<PathBuf>,
    /// Folder for the run directories, index.html, costs.html and tables as CSV
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Number of trainings at once, on the same device
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    pub jobs: u16,
    /// Print the commands of unfinished points; do not train
    #[arg(long)]
    pub dry_run: bool,
    /// Print JSON instead of tables
    #[arg(long)]
    pub json: bool,
    /// Add LPIPS to the tables, with AlexNet or VGG-16 weights as safetensors (scripts/lpips-weights.py writes them)
    #[arg(long, value_name = "WEIGHTS")]
    pub lpips: Option<PathBuf>,
    /// Input range of the LPIPS network; scores of different ranges or networks do not compare
    #[arg(long, value_name = "RANGE", value_enum, default_value_t, requires = "lpips")]
    pub lpips_range: LpipsRange,
    /// Named grid; lists replace its lists or add to them
    #[arg(long, value_enum, help_heading = GRID)]
    table: Option<Grid>,
    /// Values of alpha, the maximum black level
    #[arg(long, value_name = "LIST", help_heading = GRID)]
    alpha: Option<String>,
    /// Values of beta, the decay of the black level with brighter shadows
    #[arg(long, value_name = "LIST", help_heading = GRID)]
    beta: Option<String>,
    /// Fixed black levels delta0, or adaptive for that of alpha and beta
    #[arg(long, value_name = "LIST", help_heading = GRID)]
    offset: Option<String>,
    /// Values of any key of config.toml, such as `density.min_opacity=0.005,0.01`; repeatable
    #[arg(long, value_name = "KEY=LIST", help_heading = GRID)]
    grid: Vec<String>,
    /// Renders of another program as another row: a folder with a picture of every test view, of its size and under its
    /// name; with several datasets, a folder of each in it; repeatable
    #[arg(long, value_name = "NAME=DIR", help_heading = GRID)]
    renders: Vec<NamedRenders>,
    #[command(flatten)]
    options: Options,
}

pub(super) const GRID: &str = "Grid";

const EXAMPLES: &str = "A LIST is comma-separated. Examples:
  nightsplat sweep photos --out sweep --curves all --downscale 4 --steps 300
  nightsplat sweep photos --out parts --table parts --seeds 1,2,3
  nightsplat sweep photos --out presets --table presets --eval-every 50
  nightsplat sweep lom/buu lom/chair --out lom --curves ap3,ase --lpips lpips-alex.safetensors
  nightsplat sweep photos --out mine --curves 'ap3,a*t/(t+b); a = 1.1; b = 0.3' --renders other=pictures
  nightsplat sweep photos --out density --grid density.gradient_threshold=5e-4,1e-3 --jobs 2";

/// Trains the unfinished points and writes the results.
pub fn run(args: &SweepArgs) -> Result<()> {
    if !args.more.is_empty() {
        return scenes::run(args);
    }
    let dataset = std::path::absolute(&args.dataset)?;
    let name = dataset.file_name().unwrap_or_default().to_string_lossy();
    run_titled(args, &format!("Sweep of {name}"), &[], None)
}

/// As [`run`], with a title, an introduction and the page of a model for the page.
pub(super) fn run_titled(
    args: &SweepArgs,
    title: &str,
    intro: &[String],
    window: Option<[String; 2]>,
) -> Result<()> {
    let Some((rows, failures)) = swept(args, title, intro, window)? else { return Ok(()) };
    if let Some(failure) = failures.first() {
        let (failed, all) = (failures.len(), rows.runs);
        anyhow::bail!("{failed} of {all} points failed; the first: {}", failure.reason);
    }
    Ok(())
}

/// Trains the unfinished points and writes and prints the results; `None` after a dry run.
fn swept(
    args: &SweepArgs,
    title: &str,
    intro: &[String],
    window: Option<[String; 2]>,
) -> Result<Option<(SweepResults, Vec<FailedPoint>)>> {
    check_writable(&args.out)?;
    let (trainings, dataset) = plan(args)?;
    let mut left = vec![];
    for training in &trainings {
        if !training.is_finished()? {
            left.push(training);
        }
    }
    let first = &trainings[0].config;
    if !args.dry_run && !left.is_empty() {
        open(first)?;
    }
    claim(args, &trainings)?;
    if args.dry_run {
        for training in left {
            print(training.command_line()?)?;
        }
        return Ok(None);
    }
    let bar = progress_bar(left.len());
    let failures = runner::train(&left, args.jobs.into(), &bar, &args.out, trainings.len())?;
    let mut runs: Vec<SweepRun> = trainings.iter().map(|training| training.run.clone()).collect();

    if let Some(weights) = &args.lpips {
        let finished = runs.iter().filter(|run| run.metrics().is_some());
        let folders: Vec<&Path> = finished.map(|run| run.folder.as_path()).collect();
        scores::add_lpips(&folders, &open(first)?, weights, args.lpips_range.into())?;
    }
    for renders in &args.renders {
        runs.push(scores::of_renders(renders, args, &dataset, first)?);
    }
    let rows = SweepResults::new(&runs, args.table.and_then(Grid::baseline));
    let settings = settings(&trainings, &rows.seeds, &args.options.shared);
    let leaderboard = Leaderboard {
        rows: &rows,
        title: title.to_owned(),
        intro: intro.iter().cloned().chain([settings]).collect(),
        window,
        adaptive_offset: adaptive_offset(&trainings, &dataset),
        failures: &failures,
    };
    // Images need the device; scores do not.
    let pictures = match open(first) {
        Ok(gpu) => leaderboard.pictures(&runs, &dataset, &gpu)?,
        Err(problem) => {
            tracing::warn!("{}: no images: {problem}", args.out.display());
            None
        }
    };
    leaderboard.save(&args.out, pictures)?;
    rows.save_costs(&args.out, title, &leaderboard.notes())?;
    if args.json {
        print(format_args!("{:#}", rows.json(&dataset.root, &failures)))?;
    } else {
        let tables = [leaderboard.table(), rows.costs()].map(|table| table.text());
        tell(tables.join("\n") + "\n");
        let out = args.out.display();
        finish(&format!("{out}/index.html, {out}/costs.html"), &format!("open {out}/index.html"));
    }
    Ok(Some((rows, failures)))
}

fn open(config: &TrainConfig) -> crate::Result<Gpu> {
    driver::open(&config.device.parse::<DeviceChoice>()?)
}

/// The points of the grid, each checked as in `train`, and their dataset.
fn plan(args: &SweepArgs) -> crate::Result<(Vec<SweepTraining>, Dataset)> {
    let lists = [("alpha", &args.alpha), ("beta", &args.beta), (OFFSET, &args.offset)];
    let mut axes = vec![];
    for (key, list) in lists {
        axes.extend(list.as_deref().map(|list| SweepAxis::new(key, list)).transpose()?);
    }
    for (key, list) in &args.options.lists {
        axes.push(SweepAxis::new(key, list)?);
    }
    for list in &args.grid {
        axes.push(SweepAxis::parse(list)?);
    }
    let shared = &args.options.shared;
    if args.table == Some(Grid::Parts) && shared.iter().any(|it| it == "--model" || it == "--parts")
    {
        let problem = "--table parts sets the parts; leave out --model and --parts (--ssim-weight 0 has \
                       the loss of lita)";
        return Err(Error::Usage(problem.to_owned()));
    }
    let points = grid::points(&axes, args.table)?;
    let (dataset, out) = (absolute(&args.dataset)?, PathBuf::from(absolute(&args.out)?));
    let mut trainings: Vec<SweepTraining> = vec![];
    for point in points {
        let training = SweepTraining::new(point, &dataset, shared, &out)?;
        let is_same = |other: &&SweepTraining| other.config == training.config;
        match trainings.iter().find(is_same).map(|other| &other.run.name) {
            None => trainings.push(training),
            Some(other) if args.table.is_some() => {
                tracing::info!("{} is skipped: it is the same run as {other}", training.run.name);
            }
            Some(one) => {
                let other = &training.run.name;
                let problem = format!("{one} and {other} are the same run; leave one out");
                return Err(Error::Usage(problem));
            }
        }
    }
    let first = &trainings[0].config;
    let dataset = Dataset::load(&first.dataset, &diagnosed(first))?;
    if !dataset.test_views().any(|view| view.has_reference() || view.has_photograph()) {
        let problem = "has no held-out view to score; pass --test-every N, or list one in transforms_test.json or \
         test.txt: of eight photographs or more every eighth is held out";
        return Err(Error::input(&dataset.root, problem));
    }
    for NamedRenders { folder, .. } in &args.renders {
        if !dataset.test_views().any(View::has_reference) {
            let problem = "has no reference images: each run is scored against its own targets, with which --renders \
                           do not compare; `nightsplat compare` scores all against those of one run";
            return Err(Error::input(&dataset.root, problem));
        }
        ViewPictures::of_tests(folder, &dataset)?;
    }
    if !dataset.train_views().any(|view| view.depth.is_some()) {
        trainings.retain(|it| it.run.point.value(PARTS) != Some(Part::Depth.name()));
    }
    if !dataset.train_views().any(|view| view.normals.is_some()) {
        trainings.retain(|it| it.run.point.value(PARTS) != Some(Part::Normals.name()));
    }
    Ok((trainings, dataset))
}

/// Claims a folder that is empty, has this sweep, or has no file that a sweep would replace.
fn claim(args: &SweepArgs, trainings: &[SweepTraining]) -> crate::Result<()> {
    let (folder, manifest) = (&args.out, manifest(args, trainings)?);
    let path = folder.join("sweep.toml");
    if path.exists() {
        let found = input::text(&path)?;
        if found != manifest {
            let differs = difference(&found, &manifest);
            let problem = format!("contains another sweep ({differs}); choose another --out");
            return Err(Error::output(folder, problem));
        }
        return Ok(());
    }
    let files = LEADERBOARD_FILES.iter().chain(&COST_FILES);
    if let Some(file) = files.into_iter().find(|file| folder.join(file).exists()) {
        let problem = format!("contains {file}, which no sweep wrote; choose another --out");
        return Err(Error::output(folder, problem));
    }
    if args.dry_run {
        return Ok(());
    }
    create_folder(folder)?;
    write_whole(&path, manifest.as_bytes())
}

/// The contents of `sweep.toml`: the sweep without the values of its lists.
fn manifest(args: &SweepArgs, trainings: &[SweepTraining]) -> crate::Result<String> {
    #[derive(Serialize)]
    struct SweepManifest<'a> {
        dataset: String,
        train: &'a [String],
        lists: Vec<&'a str>,
    }
    let keys = trainings
        .iter()
        .flat_map(|training| &training.run.point.values)
        .map(|(key, _)| key.as_str());
    let mut lists: Vec<&str> = keys.collect();
    lists.sort_unstable();
    lists.dedup();
    let manifest =
        SweepManifest { dataset: absolute(&args.dataset)?, train: &args.options.shared, lists };
    toml::to_string(&manifest).map_err(|error| Error::Usage(error.to_string()))
}

/// A sentence on the number of runs and their common options.
fn settings(trainings: &[SweepTraining], seeds: &[String], shared: &[String]) -> String {
    let mut steps: Vec<u64> = trainings.iter().map(|training| training.config.steps).collect();
    steps.sort_unstable();
    steps.dedup();
    let steps: Vec<String> = steps.iter().map(u64::to_string).collect();
    let mut text = format!("{} runs of {} steps", trainings.len(), steps.join(" or "));
    if seeds.len() > 1 {
        let seeds = seeds.join(", ");
        text += &format!("; scores are means over the seeds {seeds}, and bars their range");
    }
    if !shared.is_empty() {
        text += &format!("; all with {}", shared.join(" "));
    }
    text + ". The folder of each run has its config.toml."
}

/// Mean delta0 over the training views, if the sweep has the adaptive black level.
fn adaptive_offset(trainings: &[SweepTraining], dataset: &Dataset) -> Option<f64> {
    let is_adaptive = |it: &&SweepTraining| it.run.point.value(OFFSET) == Some(ADAPTIVE);
    let config = &trainings.iter().find(is_adaptive)?.config;
    // Unreadable photographs are reported by the training.
    let images = dataset.train_views().filter_map(|view| view.loaded().ok().flatten());
    let offsets: Vec<f64> =
        images.map(|image| config.tone.offset(Statistics::new(&image.data).ratio())).collect();
    Some(offsets.iter().sum::<f64>() / offsets.len() as f64)
}
