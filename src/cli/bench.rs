//! `nightsplat bench`: checks a training step against the CPU references, then times its kernels and stages; or finds
//! the fastest tiles.

mod ceilings;
pub mod scene;
mod stages;
mod steady;
mod tune;

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Result;
use serde_json::{Map, Value, json};

use super::{driver, finish, print, table};
use crate::Error;
use crate::ceilings::Ceiling;
use crate::gpu::{CheckReport, DeviceChoice, Gpu, PassTime};
use crate::kernels;
use crate::splats::scene::Features;
use crate::train::{PrecisionConfig, TrainConfig};
use ceilings::Ceilings;
use scene::{BenchScene, Source};
use stages::KernelTime;
use steady::Steady;

/// Check a training step against the CPU references, then time its kernels and stages.
///
/// Without a model, the scene is synthetic and always the same. A disagreement is an error once everything is printed.
/// With --tune, times the rasteriser with every tile size that the device supports, and stores the fastest in the
/// user's cache folder, where training finds it unless `NIGHTSPLAT_TUNE=off`.
#[derive(Clone, Debug, clap::Args)]
pub struct BenchArgs {
    /// Trained model to time instead: a run, seen by its first training camera, or PLY, SPZ or SOG, seen along z
    #[arg(conflicts_with = "gaussians")]
    pub model: Option<PathBuf>,
    /// Print JSON instead of tables
    #[arg(long)]
    pub json: bool,
    /// Find the fastest tile sizes of the device, and store them for training
    #[arg(long)]
    pub tune: bool,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
    /// Width of the view, pixels [default: the camera's, else 512; with --tune, 500 and 1920]
    #[arg(long)]
    pub width: Option<u32>,
    /// Height of the view, pixels [default: the camera's, else 384; with --tune, 375 and 1080]
    #[arg(long)]
    pub height: Option<u32>,
    /// Number of Gaussians
    #[arg(long, default_value_t = GAUSSIANS)]
    pub gaussians: usize,
    /// Bits of the SH coefficients above degree 0 and of Adam's moments: 32, or 16 as `train` stores them by default
    #[arg(long, value_name = "BITS", default_value = "32")]
    pub precision: String,
    /// Skip the check, which takes minutes for a million Gaussians
    #[arg(long)]
    pub unchecked: bool,
    /// Timed repetitions, after one for warm-up; the median is reported
    #[arg(long, default_value_t = 5, value_name = "N")]
    pub repeats: usize,
    /// Also time this number of steps as training submits them
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub steady: u64,
    /// Also measure what the device can do at most, and print each kernel's share of the memory's speed
    #[arg(long)]
    pub ceilings: bool,
    /// Compute for this time first, so that the clocks of an idle device rise
    #[arg(long, default_value_t = 0.0, value_name = "SECONDS")]
    pub warm: f64,
    /// Write the scene's Gaussians as PLY, for other programs
    #[arg(long, value_name = "FILE")]
    pub ply: Option<PathBuf>,
}

const SIZE: [u32; 2] = [512, 384];
const TUNED_SIZES: [[u32; 2]; 2] = [[500, 375], [1920, 1080]];
const GAUSSIANS: usize = 20_000;

/// A stage and its milliseconds.
type Timing = (&'static str, f64);

/// What is measured, and how.
struct Bench {
    gpu: Gpu,
    source: Source,
    precision: PrecisionConfig,
    repeats: usize,
}

/// The results.
struct Findings {
    checked: CheckReport,
    kernels: BTreeMap<&'static str, KernelTime>,
    stages: stages::Stages,
    ceilings: Option<Ceilings>,
    steady: Option<Steady>,
}

/// Checks, times and prints.
pub fn run(args: &BenchArgs) -> Result<()> {
    let side_holds = |side: Option<u32>| side.is_none_or(|side| (16..=8192).contains(&side));
    let numbers_hold = side_holds(args.width)
        && side_holds(args.height)
        && (1..=10_000_000).contains(&args.gaussians)
        && args.repeats > 0
        && (0.0..=60.0).contains(&args.warm);
    if !numbers_hold {
        let rule = "--width and --height take 16 to 8192, --gaussians 1 to 10000000, --repeats 1 or more, \
                    --warm at most 60";
        return Err(Error::Usage(rule.to_owned()).into());
    }
    let precision = ["rest", "moments"].map(|key| format!("precision.{key}={}", args.precision));
    let precision = TrainConfig::bare().with(&precision)?.precision;
    let source = match &args.model {
        Some(path) => Source::open(path, SIZE)?,
        None => Source::Synthetic(args.gaussians),
    };
    let size = source.size().unwrap_or(SIZE);
    let size = [args.width.unwrap_or(size[0]), args.height.unwrap_or(size[1])];
    let gpu = driver::open(&args.device.clone().unwrap_or_default())?;
    let bench = Bench { gpu, source, precision, repeats: args.repeats };
    if args.tune {
        let is_sized = args.width.is_some() || args.height.is_some();
        let sizes = if is_sized { &[size][..] } else { &TUNED_SIZES };
        return tune::run(&bench, sizes, args.json);
    }
    let scene = bench.source.scene(size, Features::NONE);
    if let Some(path) = &args.ply {
        scene.gaussians.save(path)?;
    }
    let findings = Findings::gather(&bench, &scene, args)?;
    if args.json {
        print(format_args!("{:#}", findings.as_json(&bench, &scene)))?;
    } else {
        print(findings.as_text(&bench, &scene))?;
        finish("", "nightsplat bench --tune");
    }
    Ok(findings.checked.agree()?)
}

impl Findings {
    fn gather(bench: &Bench, scene: &BenchScene, args: &BenchArgs) -> crate::Result<Self> {
        let mut trainers = scene::trainers(&bench.gpu, scene, &bench.precision)?;
        let checked = match args.unchecked {
            true => CheckReport::default(),
            false => stages::check(bench, &mut trainers)?,
        };
        let mut ceiling = match args.ceilings || args.warm > 0.0 {
            true => Some(Ceiling::large(&bench.gpu)?),
            false => None,
        };
        if let Some(ceiling) = &mut ceiling {
            ceiling.warm(&bench.gpu, Duration::from_secs_f64(args.warm))?;
        }
        let kernels = stages::time_kernels(bench, &mut trainers)?;
        let stages = stages::time(bench, &mut trainers)?;
        let ceilings = match ceiling.filter(|_| args.ceilings) {
            Some(mut ceiling) => Some(Ceilings::measure(bench, &mut ceiling)?),
            None => None,
        };
        let steady = match args.steady {
            0 => None,
            steps => Some(steady::time(bench, &mut trainers.plain, steps)?),
        };
        Ok(Self { checked, kernels, stages, ceilings, steady })
    }

    /// The kernels of which a pass disagrees with its reference.
    fn disagreeing(&self) -> BTreeSet<&'static str> {
        let passes = self.checked.passes.iter();
        passes.filter(|pass| pass.difference.is_some()).map(|pass| pass.kernel).collect()
    }

    /// The kernels that no checked pass ran.
    fn not_covered(&self) -> Vec<&'static str> {
        let covered = self.checked.kernels();
        let is_covered = |name: &str| covered.iter().any(|(covered, ..)| *covered == name);
        kernels::NAMES.iter().copied().filter(|name| !is_covered(name)).collect()
    }

    fn as_json(&self, bench: &Bench, scene: &BenchScene) -> Value {
        let entry = |(name, milliseconds): &Timing| ((*name).to_owned(), json!(milliseconds));
        let properties = bench.gpu.properties();
        let Self { stages, .. } = self;
        let errors = self.checked.kernels();
        let of_kernels = |number: fn(&KernelTime) -> f64| {
            let entry = |(name, time): (&&str, _)| ((*name).to_owned(), json!(number(time)));
            self.kernels.iter().map(entry).collect::<Map<_, _>>()
        };
        json!({
            "device": properties.name,
            "driver": properties.driver,
            "scene": bench.source.name(),
            "precision": bench.precision,
            "width": scene.camera.width,
            "height": scene.camera.height,
            "gaussians": scene.gaussians.count,
            "intersections": stages.intersections,
            "errors": errors.into_iter().map(|(name, _, error)| (name.to_owned(), json!(error))).collect::<Map<_, _>>(),
            "disagreeing": self.disagreeing(),
            "passes": self.checked.outcomes(),
            "not_covered": self.not_covered(),
            "kernels": of_kernels(|time| time.milliseconds),
            "gb_per_s_at_most": of_kernels(|time| time.speed() * 1e-9),
            "groups": stages.groups.iter().map(entry).collect::<Map<String, Value>>(),
            "step_ms": stages.step.1,
            "ceilings": self.ceilings.as_ref().map(Ceilings::as_json),
            "steady": self.steady.as_ref().map(Steady::as_json),
        })
    }

    fn as_text(&self, bench: &Bench, scene: &BenchScene) -> String {
        let (properties, stages) = (bench.gpu.properties(), &self.stages);
        let head = format!(
            "{}, {}\n{}: {}x{} pixels, {} Gaussians, {} intersections; medians of {} runs",
            properties.name,
            properties.driver,
            bench.source.name(),
            scene.camera.width,
            scene.camera.height,
            scene.gaussians.count,
            stages.intersections,
            bench.repeats
        );
        let header = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>();
        let mut rows = vec![header(&["kernel", "largest error / bound", "ms", "GB/s at most"])];
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".to_owned());
        let checked = self.checked.kernels();
        let errors: BTreeMap<_, _> =
            checked.iter().map(|&(name, _, error)| (name, error)).collect();
        let is_timed_alone = |name: &&str| !errors.contains_key(name);
        let unchecked = self.kernels.keys().copied().filter(is_timed_alone);
        let names = checked.iter().map(|&(name, ..)| name).chain(unchecked);
        rows.extend(names.map(|name| {
            let error = errors.get(name).map(|error| format!("{error:.3}"));
            let time = self.kernels.get(name);
            let milliseconds = time.map(|time| format!("{:.3}", time.milliseconds));
            let speed = time.map(|time| self.speed(time));
            vec![name.to_owned(), or_dash(error), or_dash(milliseconds), or_dash(speed)]
        }));
        let kernel_table = table::aligned(&rows);
        let mut rows = vec![header(&["stage", "ms"])];
        rows.extend(
            stages
                .groups
                .iter()
                .chain([&stages.step])
                .map(|(name, milliseconds)| vec![(*name).to_owned(), format!("{milliseconds:.2}")]),
        );
        let not_covered = self.not_covered().join(", ");
        let stage_table = table::aligned(&rows);
        let outcomes = self.checked.outcomes();
        let more = [
            self.ceilings.map(|section| section.as_text()),
            self.steady.map(|section| section.as_text()),
        ];
        let more: String = more.into_iter().flatten().map(|line| line + "\n").collect();
        format!(
            "{head}\n\n{kernel_table}{outcomes}\nnot covered: {not_covered}\n\n{stage_table}{more}"
        )
    }

    /// The bytes that a kernel's passes bind, per second, and their share of what the device can move.
    fn speed(&self, time: &KernelTime) -> String {
        let speed = format!("{:.1}", time.speed() * 1e-9);
        match self.ceilings {
            Some(peak) => format!("{speed} ({:.0} %)", 100.0 * time.speed() / peak.bytes),
            None => speed,
        }
    }
}

impl Bench {
    /// The median of the milliseconds that `once` reports, after a warm-up.
    fn median(&self, mut once: impl FnMut() -> crate::Result<f64>) -> crate::Result<f64> {
        once()?;
        let times = (0..self.repeats).map(|_| once()).collect::<crate::Result<Vec<_>>>()?;
        Ok(median(times))
    }
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

/// Milliseconds of all passes together.
fn total(times: &[PassTime]) -> f64 {
    times.iter().map(|time| time.milliseconds).sum()
}
