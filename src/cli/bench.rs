//! `nightsplat bench`: check every kernel against its CPU reference, then time it.

mod check;
mod kernels;
mod scene;
mod stages;

use std::io::Write;

use anyhow::Result;
use serde_json::{Map, Value, json};

use super::table;
use crate::Error;
use crate::gpu::{DeviceChoice, Gpu, PassTime};
use scene::Scene;

/// Check every kernel against its CPU reference, then time it, and the stages of a training step.
///
/// The scene is the same every time. Bounds are those of two processor cores at the default size.
#[derive(Clone, Debug, clap::Args)]
pub struct BenchArgs {
    /// Print JSON instead of tables: device, driver, kernels, groups and the step
    #[arg(long)]
    pub json: bool,
    /// The device: a part of its name or its index in `nightsplat doctor` [default: the best]
    #[arg(long, value_name = "NAME|INDEX")]
    pub device: Option<DeviceChoice>,
    /// Pixels per row of the view
    #[arg(long, default_value_t = WIDTH)]
    pub width: u32,
    /// Rows of the view
    #[arg(long, default_value_t = HEIGHT)]
    pub height: u32,
    /// Gaussians in the scene
    #[arg(long, default_value_t = GAUSSIANS)]
    pub gaussians: usize,
    /// Timed runs, after one that is not timed; the median counts
    #[arg(long, default_value_t = 5, value_name = "N")]
    pub repeats: usize,
}

const WIDTH: u32 = 512;
const HEIGHT: u32 = 384;
const GAUSSIANS: usize = 20_000;

/// What something took.
#[derive(Clone, Debug)]
struct Timing {
    name: &'static str,
    milliseconds: f64,
    /// Milliseconds that two processor cores may take at the default size.
    bound: Option<f64>,
}

/// What the bench runs on, and how often.
struct Bench {
    gpu: Gpu,
    repeats: usize,
}

/// Checks, times and prints.
///
/// # Errors
/// A kernel disagrees with its reference, or there is no such device.
pub fn run(args: &BenchArgs) -> Result<()> {
    let sizes_hold = (16..=8192).contains(&args.width)
        && (16..=8192).contains(&args.height)
        && (1..=10_000_000).contains(&args.gaussians)
        && args.repeats > 0;
    if !sizes_hold {
        let rule =
            "--width and --height take 16 to 8192, --gaussians 1 to 10000000, --repeats 1 or more";
        return Err(Error::Usage(rule.to_owned()).into());
    }
    let gpu = Gpu::new(&args.device.clone().unwrap_or_default())?;
    let bench = Bench { gpu, repeats: args.repeats };
    let scene = Scene::new(args.width, args.height, args.gaussians);
    let kernels = kernels::check_and_time(&bench, &scene)?;
    let stages = stages::time(&bench, &scene)?;
    let mut out = std::io::stdout().lock();
    if args.json {
        writeln!(out, "{:#}", as_json(&bench, &kernels, &stages))?;
    } else {
        let has_bounds = (args.width, args.height, args.gaussians) == (WIDTH, HEIGHT, GAUSSIANS);
        write!(out, "{}", as_text(&bench, &scene, &kernels, &stages, has_bounds))?;
    }
    Ok(())
}

fn as_json(bench: &Bench, kernels: &[Timing], stages: &stages::Stages) -> Value {
    let map = |timings: &[Timing]| {
        let entry = |timing: &Timing| (timing.name.to_owned(), json!(timing.milliseconds));
        timings.iter().map(entry).collect::<Map<String, Value>>()
    };
    let properties = bench.gpu.properties();
    json!({
        "device": properties.name,
        "driver": properties.driver,
        "intersections": stages.intersections,
        "kernels": map(kernels),
        "groups": map(&stages.groups),
        "step_ms": stages.step.milliseconds,
    })
}

fn as_text(
    bench: &Bench,
    scene: &Scene,
    kernels: &[Timing],
    stages: &stages::Stages,
    has_bounds: bool,
) -> String {
    let properties = bench.gpu.properties();
    let head = format!(
        "{}, {}\n{}x{} pixels, {} Gaussians, {} intersections; medians of {} runs",
        properties.name,
        properties.driver,
        scene.camera.width,
        scene.camera.height,
        scene.gaussians.count,
        stages.intersections,
        bench.repeats
    );
    let header = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>();
    let mut rows = vec![header(&["kernel (agrees with its reference)", "ms"])];
    rows.extend(kernels.iter().map(|k| vec![k.name.to_owned(), format!("{:.2}", k.milliseconds)]));
    let kernel_table = table::aligned(&rows);
    let mut rows = vec![header(&["stage", "ms", "bound", "within"])];
    rows.extend(stages.groups.iter().chain([&stages.step]).map(|stage| {
        let mut row = vec![stage.name.to_owned(), format!("{:.2}", stage.milliseconds)];
        if let Some(bound) = stage.bound.filter(|_| has_bounds) {
            let within = if stage.milliseconds <= bound { "yes" } else { "no" };
            row.extend([format!("{bound:.0}"), within.to_owned()]);
        }
        row
    }));
    format!("{head}\n\n{kernel_table}\n{}", table::aligned(&rows))
}

impl Bench {
    /// The median of the milliseconds that `once` reports, after a run that does not count.
    fn median(&self, mut once: impl FnMut() -> crate::Result<f64>) -> crate::Result<f64> {
        once()?;
        let mut times = (0..self.repeats).map(|_| once()).collect::<crate::Result<Vec<_>>>()?;
        times.sort_by(f64::total_cmp);
        Ok(times[times.len() / 2])
    }
}

/// Milliseconds of all passes together.
fn total(times: &[PassTime]) -> f64 {
    times.iter().map(|time| time.milliseconds).sum()
}
