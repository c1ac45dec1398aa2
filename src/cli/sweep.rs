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
mod options;
mod runner;

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::{Args, FromArgMatches};
use serde::Serialize;

use self::grid::{ADAPTIVE, Axis, OFFSET, PaperTable, Point};
use self::leaderboard::Leaderboard;
use self::options::Options;
use super::progress_bar;
use super::train::TrainArgs;
use crate::Error;
use crate::dataset::Dataset;
use crate::gpu::{DeviceChoice, Gpu};
use crate::output::write_whole;
use crate::run::load_config;
use crate::tone::Statistics;
use crate::train::TrainConfig;

/// Train over a grid of settings, each point in its own run directory, and rank the results.
///
/// A point is one `nightsplat train` command, run as a process of its own. Interrupt the sweep at any time and give the
/// same command again: finished points stay, the others are trained anew. A point that fails is reported, and the
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
    options: Options,
}

const EXAMPLES: &str = "A LIST is comma-separated. Examples:
  nightsplat sweep photos --out sweep --curves all --downscale 4 --steps 300
  nightsplat sweep photos --out offsets --table offset --seeds 1,2,3
  nightsplat sweep photos --out density --grid density.gradient_threshold=1e-4,2e-4 --jobs 2";

/// A point with everything that training it takes.
#[derive(Clone, Debug)]
struct Run {
    name: String,
    point: Point,
    folder: PathBuf,
    /// Of `nightsplat`.
    arguments: Vec<String>,
    /// What these arguments come to.
    config: TrainConfig,
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
        Gpu::new(&first.device.parse::<DeviceChoice>()?)?;
    }
    claim(&args.out, &manifest(args, &runs)?, args.dry_run)?;
    let mut out = std::io::stdout().lock();
    if args.dry_run {
        for run in left {
            writeln!(out, "{}", run.command_line()?)?;
        }
        return Ok(());
    }
    let bar = progress_bar(left.len());
    let failures = runner::train(&left, args.jobs.into(), &bar);

    let baseline = args.table.and_then(PaperTable::baseline);
    let leaderboard = Leaderboard::new(&runs, baseline, adaptive_offset(&runs, &dataset));
    leaderboard.save(&args.out, &failures)?;
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
        let (key, list) = list
            .split_once('=')
            .ok_or_else(|| Error::Usage(format!("--grid {list} has no values; write KEY=V1,V2")))?;
        axes.push(Axis::new(key, list)?);
    }
    let points = grid::points(&axes, args.table)?;
    let (dataset, out) = (absolute(&args.dataset)?, absolute(&args.out)?);
    let mut runs: Vec<Run> = vec![];
    for point in points {
        let run = Run::new(point, &dataset, &args.options.shared, Path::new(&out))?;
        if let Some(other) = runs.iter().find(|other| other.config == run.config) {
            let problem =
                format!("{} and {} are the same run; leave one out", other.name, run.name);
            return Err(Error::Usage(problem));
        }
        runs.push(run);
    }
    Ok(runs)
}

impl Run {
    fn new(point: Point, dataset: &str, shared: &[String], out: &Path) -> crate::Result<Self> {
        let name = point.name();
        let folder = out.join(&name);
        let mut arguments = vec!["train".to_owned(), dataset.to_owned()];
        arguments.extend_from_slice(shared);
        arguments.extend(point.arguments());
        // Points are to differ by what the grid says alone.
        arguments.extend(["--plan", "none"].map(str::to_owned));
        arguments.extend(["--out".to_owned(), unicode(&folder)?, "--overwrite".to_owned()]);
        let train = TrainArgs::augment_args(clap::Command::new("train"));
        let parsed = train
            .try_get_matches_from(&arguments)
            .and_then(|matches| TrainArgs::from_arg_matches(&matches));
        let args = parsed.map_err(|error| {
            let text = error.to_string();
            let line = text.lines().next().unwrap_or_default();
            Error::Usage(format!("{name}: {}", line.trim_start_matches("error: ")))
        })?;
        let config = args.options.config(args.dataset)?;
        Ok(Self { name, point, folder, arguments, config })
    }

    /// Whether the run directory holds this run to its end.
    fn is_finished(&self) -> crate::Result<bool> {
        let path = self.folder.join("config.toml");
        if !path.exists() {
            return Ok(false);
        }
        let found = load_config(&self.folder)?;
        // A run records the tile that it took; where none is asked for, any is right.
        let found = TrainConfig { tile: self.config.tile.and(found.tile), ..found };
        if found != self.config {
            let differs = difference(&found.to_toml()?, &self.config.to_toml()?);
            let problem = format!("holds another run ({differs}); choose another --out");
            return Err(Error::output(&self.folder, problem));
        }
        Ok(self.metrics().is_some())
    }

    /// What `metrics.json` says, where the run is finished.
    fn metrics(&self) -> Option<serde_json::Value> {
        let text = std::fs::read(self.folder.join("metrics.json")).ok()?;
        serde_json::from_slice(&text).ok()
    }

    /// The command as a shell takes it.
    fn command_line(&self) -> crate::Result<String> {
        let program = std::env::current_exe()
            .map_err(|error| Error::input("nightsplat", format!("cannot be found: {error}")))?;
        let words = std::iter::once(unicode(&program)?).chain(self.arguments.iter().cloned());
        Ok(words.map(|word| quoted(&word)).collect::<Vec<_>>().join(" "))
    }
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

/// Takes a folder that is empty, holds this sweep or holds nothing that a sweep would replace.
fn claim(folder: &Path, manifest: &str, dry_run: bool) -> crate::Result<()> {
    const NAME: &str = "sweep.toml";
    let path = folder.join(NAME);
    if path.exists() {
        let found = std::fs::read_to_string(&path)
            .map_err(|error| Error::input(&path, format!("cannot be read: {error}")))?;
        if found != manifest {
            let differs = difference(&found, manifest);
            let problem = format!("holds another sweep ({differs}); choose another --out");
            return Err(Error::output(folder, problem));
        }
        return Ok(());
    }
    if let Some(file) = leaderboard::FILES.iter().find(|file| folder.join(file).exists()) {
        let problem = format!("holds {file}, which no sweep wrote; choose another --out");
        return Err(Error::output(folder, problem));
    }
    if dry_run {
        return Ok(());
    }
    std::fs::create_dir_all(folder)
        .map_err(|error| Error::output(folder, format!("cannot be made: {error}")))?;
    write_whole(&path, manifest.as_bytes())
}

/// delta0, the mean over the training views, where the sweep has the adaptive black level.
fn adaptive_offset(runs: &[Run], dataset: &Dataset) -> Option<f64> {
    let run = runs.iter().find(|run| run.point.value(OFFSET) == Some(ADAPTIVE))?;
    let images = dataset.train_views().filter_map(|view| view.image.as_ref());
    let offsets: Vec<f64> =
        images.map(|image| run.config.tone.offset(Statistics::of(&image.data).ratio())).collect();
    Some(offsets.iter().sum::<f64>() / offsets.len() as f64)
}

/// The first line in which two files differ.
fn difference(found: &str, wanted: &str) -> String {
    let wanted: Vec<&str> = wanted.lines().collect();
    let is_new = |line: &&str| !wanted.contains(line);
    let line = found.lines().find(is_new).unwrap_or("its configuration lacks a setting");
    line.to_owned()
}

fn absolute(path: &Path) -> crate::Result<String> {
    let path = std::path::absolute(path)
        .map_err(|error| Error::input(path, format!("cannot be found: {error}")))?;
    unicode(&path)
}

fn unicode(path: &Path) -> crate::Result<String> {
    path.to_str().map(str::to_owned).ok_or_else(|| {
        Error::Usage(format!("{} is not Unicode; move it to a path that is", path.display()))
    })
}

/// A word that a POSIX shell reads back as it is.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./=,+:@%".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', "'\\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_quoted_where_a_shell_needs_it() {
        assert_eq!(quoted("--set"), "--set");
        assert_eq!(quoted("curve=ap3,seed=1"), "curve=ap3,seed=1");
        assert_eq!(quoted("a b"), "'a b'");
        assert_eq!(quoted("it's"), "'it'\\''s'");
        assert_eq!(quoted(""), "''");
    }
}
