//! `nightsplat tradeoff`: what time, energy and memory buy on a dataset.
//!
//! ```text
//! OUT/tradeoff.toml       what is compared here; another comparison needs another folder
//!     plan-PRESET.toml    what `train --preset PRESET` decides for these photographs
//!     pseudo_gt/          what is scored against where there are no reference images
//!     NAME/               a run directory per point, with log.txt beside what `train` writes
//!     tradeoff.csv        a row per point, seeds averaged
//!     anytime.csv         scores on the way
//!     index.html          fronts, pictures, curves, tables
//! ```

mod knobs;
mod outcome;
mod page;
mod target;

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Result;
use clap::Args;
use serde::Serialize;

use self::knobs::BASE;
use self::outcome::Outcome;
use self::page::Page;
use self::target::{Target, write_pseudo_gt};
use super::batch::options::{Lists, Options};
use super::batch::point::{Axis, PRESET, Point, SEED};
use super::batch::runner::Failure;
use super::batch::{self, Common, Run, absolute, runner, train_args};
use super::{progress_bar, table};
use crate::Error;
use crate::base::output::write_whole;
use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::Dataset;
use crate::results::run::energy_counters;
use crate::train::diagnose::{Diagnosis, Plan};
use crate::train::{Preset, TrainConfig, Trainer, diagnosed};

/// Train the presets, and every single change of balanced, and draw what time and memory buy.
///
/// Leaves OUT/index.html, a page with the fronts of PSNR and SSIM against seconds (on the wall and
/// of the processors), energy where the machine counts it, and memory; how each run came there,
/// scored on the way without counting that; and what each change gains and costs. The same is in
/// tradeoff.csv and anytime.csv. Interrupt it at any time and give the same command again: finished
/// points stay. A point that fails, for lack of memory say, is named, and the others go on.
///
///   nightsplat tradeoff photos --out tradeoff --downscale 4
///   nightsplat tradeoff photos --out presets --no-knobs --seeds 1,2,3
///   nightsplat tradeoff photos --out own --no-knobs --knob density.min_opacity=0.005,0.02
#[expect(clippy::doc_markdown, reason = "help shows settings as they are written")]
#[derive(Clone, Debug, Args)]
#[command(verbatim_doc_comment)]
pub struct TradeoffArgs {
    /// The dataset, as for `train`
    pub dataset: PathBuf,
    /// The folder of the comparison: a run directory per point, index.html, tradeoff.csv, anytime.csv
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// The presets to train
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_values_t = DEFAULT_PRESETS)]
    pub presets: Vec<Preset>,
    /// Values of a setting by its place in config.toml, each in place of balanced's; may be repeated
    #[arg(long, value_name = "KEY=LIST")]
    pub knob: Vec<String>,
    /// Leave out the built-in changes of balanced: steps, stop.gain, schedule.resolution_steps, schedule.boost, max_gaussians, sh_degree, density.gradient_threshold, ssim_weight
    #[arg(long)]
    pub no_knobs: bool,
    /// Print what would be trained, with an estimate of its time, and train nothing
    #[arg(long)]
    pub dry_run: bool,
    /// Print every figure as JSON instead of tables
    #[arg(long)]
    pub json: bool,
    #[command(flatten, next_help_heading = "What every point is trained with")]
    options: Options<TradeoffLists>,
}

const DEFAULT_PRESETS: [Preset; 4] = [Preset::Draft, Preset::Fast, Preset::Balanced, Preset::Best];

/// What a comparison takes as lists.
#[derive(Clone, Copy, Debug)]
struct TradeoffLists;

impl Lists for TradeoffLists {
    const LISTS: &'static [(&'static str, &'static str, &'static str)] =
        &[(SEED, "seeds", "Seeds; figures are means over them, with their standard deviation")];
}

/// The files that a comparison leaves beside its runs.
const FILES: [&str; 3] = ["index.html", "tradeoff.csv", "anytime.csv"];

/// Scores on the way of a run that comes to its last step, and the steps between two at least.
const SCORES: u64 = 40;
const LEAST_STEPS: u64 = 25;

/// What is to be trained, and how it is scored.
struct Comparison {
    gpu: Gpu,
    dataset: Dataset,
    target: Target,
    /// By the name of the preset: the file it is to have, and the plan.
    plans: BTreeMap<&'static str, (String, Plan)>,
    runs: Vec<Run>,
}

/// Trains what is left and writes the page.
///
/// # Errors
/// A knob, an option or a dataset that makes no sense, before anything is trained; a folder that holds another comparison;
/// points that failed, after the others are finished.
pub fn run(args: &TradeoffArgs) -> Result<()> {
    let claim = |writes| batch::claim(&args.out, "tradeoff", &manifest(args)?, &FILES, writes);
    // Before the plans in the folder are read, which are for its own dataset.
    claim(false)?;
    let mut comparison = Comparison::new(args)?;
    let mut left = vec![];
    for run in &comparison.runs {
        if !run.is_finished()? {
            left.push(run.clone());
        }
    }
    claim(!args.dry_run)?;
    let mut out = std::io::stdout().lock();
    if args.dry_run {
        write!(out, "{}", comparison.estimate(&left)?)?;
        return Ok(());
    }
    comparison.prepare(args)?;
    let (bar, all) = (progress_bar(left.len()), comparison.runs.len());
    let left: Vec<&Run> = left.iter().collect();
    let failures = runner::train(&left, 1, &bar, (&args.out, all))?;
    let outcomes = Outcome::all(&comparison.runs);
    let page = comparison.page(&outcomes, &failures).html()?;
    for (file, text) in
        FILES.iter().zip([page, outcome::csv(&outcomes), outcome::anytime_csv(&outcomes)])
    {
        write_whole(&args.out.join(file), text.as_bytes())?;
    }
    if args.json {
        writeln!(out, "{:#}", comparison.json(&outcomes, &failures))?;
    } else {
        let tables =
            std::iter::once(outcome::table(&outcomes)).chain(outcome::marginal_table(&outcomes));
        let tables: Vec<String> = tables.map(|one| table::of(&one)).collect();
        writeln!(out, "{}{}", tables.join("\n"), args.out.join(FILES[0]).display())?;
    }
    if let Some(failure) = failures.first() {
        let (failed, all) = (failures.len(), comparison.runs.len());
        anyhow::bail!(
            "{failed} of {all} points were skipped; the first, {}: {}",
            failure.name,
            failure.reason
        );
    }
    Ok(())
}

impl Comparison {
    fn new(args: &TradeoffArgs) -> crate::Result<Self> {
        if args.options.shared.iter().any(|argument| argument.starts_with("--preset")) {
            let problem = "tradeoff trains presets side by side; name them with --presets";
            return Err(Error::Usage(problem.to_owned()));
        }
        let axes = knobs::axes(&args.knob, !args.no_knobs)?;
        let seeds = args.options.lists.iter().map(|(key, list)| Axis::new(key, list));
        let seeds = seeds.collect::<crate::Result<Vec<_>>>()?;
        let (path, out) = (absolute(&args.dataset)?, absolute(&args.out)?);
        let mut shared = args.options.shared.clone();
        let points = knobs::points(&args.presets, &axes, seeds.first());

        let base = config_of(BASE, &path, &shared)?;
        let gpu = Gpu::new(&base.device.parse::<DeviceChoice>()?)?;
        let mut dataset = Dataset::load(&base.dataset, &diagnosed(&base))?;
        let target = Target::of(&dataset)?;
        let plans = plans(&gpu, &dataset, &points, &path, &shared, &out)?;
        // All are of one diagnosis.
        if let Some((_, plan)) = plans.values().next() {
            dataset.leave_out(&plan.left_out);
        }
        if target == Target::PseudoGt {
            shared.extend(["--reference".to_owned(), pseudo_gt(&out)]);
        }
        let runs = runs(points, &path, &shared, &out, &plans)?;
        Ok(Self { gpu, dataset, target, plans, runs })
    }

    /// Writes what the points are trained and scored with.
    fn prepare(&mut self, args: &TradeoffArgs) -> crate::Result<()> {
        for (file, plan) in self.plans.values() {
            if !Path::new(file).exists() {
                write_whole(Path::new(file), plan.to_toml()?.as_bytes())?;
            }
        }
        if self.target == Target::PseudoGt {
            let folder = PathBuf::from(pseudo_gt(Path::new(&absolute(&args.out)?)));
            let is_base = |run: &&Run| run.point.value(PRESET) == Some(BASE.name());
            let base = self.runs.iter().find(is_base).or(self.runs.first());
            let Some(run) = base else { return Ok(()) };
            let config = &run.config;
            // The mark of a folder that is whole, which a killed command does not leave.
            let done = folder.join("whole");
            if !done.exists() {
                write_pseudo_gt(&config.dataset, config.tone.clone(), &config.device, &folder)?;
                write_whole(&done, b"")?;
            }
            self.dataset = Dataset::load(&config.dataset, &config.load_options())?;
        }
        Ok(())
    }

    /// A line per point: its steps at most, and what they take at the speed of the first steps.
    fn estimate(&self, left: &[Run]) -> crate::Result<String> {
        const WARMUP: u64 = 4;
        const TIMED: u64 = 12;
        let mut rows = vec![["point", "steps at most", "about, s"].map(str::to_owned).to_vec()];
        let Some(first) = left.first() else { return Ok("every point is finished\n".to_owned()) };
        let mut config = TrainConfig { reference: None, ..first.config.clone() };
        config.schedule.resolution_steps = [0, 0];
        config.steps = WARMUP + TIMED;
        let mut trainer = Trainer::new(&self.gpu, config, &self.dataset)?;
        trainer.advance(WARMUP)?;
        let begin = Instant::now();
        trainer.advance(WARMUP + TIMED)?;
        let each = begin.elapsed().as_secs_f64() / TIMED as f64;
        let mut total = 0.0;
        for run in left {
            let (steps, [quarter, half]) = (run.config.steps, run.config.schedule.resolution_steps);
            // A step at half the size has a quarter of the pixels.
            let whole = steps.saturating_sub(half) as f64;
            let halves = half.min(steps).saturating_sub(quarter) as f64;
            let seconds = each * (whole + halves / 4.0 + quarter.min(steps) as f64 / 16.0);
            total += seconds;
            rows.push(vec![run.name.clone(), steps.to_string(), format!("{seconds:.0}")]);
        }
        let steps: u64 = left.iter().map(|run| run.config.steps).sum();
        rows.push(vec!["all".to_owned(), steps.to_string(), format!("{total:.0}")]);
        let remark = "at the speed of the first steps: more Gaussians take longer, and what converges ends sooner\n";
        Ok(table::aligned(&rows) + remark)
    }

    fn page<'a>(&'a self, outcomes: &'a [Outcome], failures: &'a [Failure]) -> Page<'a> {
        let Self { gpu, dataset, target, runs, .. } = self;
        Page { dataset, target: *target, gpu, runs, outcomes, failures }
    }

    fn json(&self, outcomes: &[Outcome], failures: &[Failure]) -> serde_json::Value {
        let failed = |Failure { name, reason }: &Failure| serde_json::json!({"point": name, "reason": reason});
        serde_json::json!({
            "dataset": self.dataset.root.display().to_string(),
            "device": self.gpu.properties().name,
            "scored_against": self.target.key(),
            "energy_counters": energy_counters(),
            "points": outcome::json(outcomes),
            "skipped": failures.iter().map(failed).collect::<Vec<_>>(),
        })
    }
}

/// The folder of the pseudo-GT that stands for references.
fn pseudo_gt(out: impl AsRef<Path>) -> String {
    out.as_ref().join("pseudo_gt").to_string_lossy().into_owned()
}

/// What `train --preset` has before its photographs are looked at.
fn config_of(preset: Preset, dataset: &str, shared: &[String]) -> crate::Result<TrainConfig> {
    let args = train_args(preset.name(), &arguments(preset, dataset, shared))?;
    args.options.config(&args.dataset, None)
}

fn arguments(preset: Preset, dataset: &str, shared: &[String]) -> Vec<String> {
    let first = ["train", dataset, "--out", "run", "--preset", preset.name()].map(str::to_owned);
    first.into_iter().chain(shared.iter().cloned()).collect()
}

/// The plans of the presets that have one, each as `train` makes it; those in the folder already stay.
fn plans(
    gpu: &Gpu,
    dataset: &Dataset,
    points: &[Point],
    path: &str,
    shared: &[String],
    out: &str,
) -> crate::Result<BTreeMap<&'static str, (String, Plan)>> {
    let mut plans = BTreeMap::new();
    let mut diagnosis = None;
    for name in points.iter().filter_map(|point| point.value(PRESET)) {
        let preset: Preset = name.parse()?;
        let args = train_args(preset.name(), &arguments(preset, path, shared))?;
        if plans.contains_key(preset.name()) || !args.options.wants_a_plan() {
            continue;
        }
        let file = batch::unicode(&Path::new(out).join(format!("plan-{}.toml", preset.name())))?;
        let plan = if Path::new(&file).exists() {
            Plan::load(Path::new(&file), dataset)?
        } else {
            let config = args.options.config(&args.dataset, None)?;
            if diagnosis.is_none() {
                diagnosis = Some(Diagnosis::of(dataset, &diagnosed(&config))?);
            }
            let Some(diagnosis) = &diagnosis else { continue };
            Plan::new(diagnosis, &config, gpu.properties().memory)
        };
        plans.insert(preset.name(), (file, plan));
    }
    Ok(plans)
}

/// The runs of the points; a change that is none is left out.
fn runs(
    points: Vec<Point>,
    dataset: &str,
    shared: &[String],
    out: &str,
    plans: &BTreeMap<&'static str, (String, Plan)>,
) -> crate::Result<Vec<Run>> {
    let scores_by_itself = shared.iter().any(|argument| argument.starts_with("--eval-every"));
    let mut runs: Vec<Run> = vec![];
    for point in points {
        let preset: Preset = point.value(PRESET).unwrap_or_default().parse()?;
        let plan = plans.get(preset.name()).map(|(file, plan)| (file.as_str(), plan));
        let mut shared = shared.to_vec();
        if !scores_by_itself {
            let every = (config_of(preset, dataset, &shared)?.steps / SCORES).max(LEAST_STEPS);
            shared.extend(["--eval-every".to_owned(), every.to_string()]);
        }
        let run = Run::new(point, Common { dataset, shared: &shared, out }, plan)?;
        match runs.iter().find(|other| other.config == run.config) {
            None => runs.push(run),
            Some(other) => {
                tracing::info!("{} is left out: it is the same run as {}", run.name, other.name);
            }
        }
    }
    Ok(runs)
}

/// What `tradeoff.toml` says: the comparison without its points.
fn manifest(args: &TradeoffArgs) -> crate::Result<String> {
    #[derive(Serialize)]
    struct Manifest<'a> {
        dataset: String,
        train: &'a [String],
    }
    let manifest = Manifest { dataset: absolute(&args.dataset)?, train: &args.options.shared };
    toml::to_string(&manifest).map_err(|error| Error::Usage(error.to_string()))
}
