//! `nightsplat bench`: checks a training step against the CPU references, then times its kernels and stages; or finds
//! the fastest tiles.

use std::path::PathBuf;

use anyhow::Result;
use nightsplat_models::gaussians::Features;

use super::{finish, print};
use crate::Error;
use crate::bench::tuning::TuningTimings;
use crate::bench::{Bench, BenchOptions, Findings, Source};
use crate::driver;
use crate::gpu::{DeviceChoice, TUNE_VARIABLE, TunedTile};
use crate::train::TrainConfig;

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
    /// Find the fastest tile sizes of the device, and strips for SSIM, and store them for training
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
        return tune(&bench, sizes, args.json);
    }
    let scene = bench.source.scene(size, Features::NONE);
    if let Some(path) = &args.ply {
        scene.gaussians.save(path)?;
    }
    let findings = Findings::gather(
        &bench,
        &scene,
        &BenchOptions {
            unchecked: args.unchecked,
            ceilings: args.ceilings,
            warm: args.warm,
            steady: args.steady,
        },
    )?;
    if args.json {
        print(format_args!("{:#}", findings.as_json(&bench, &scene)))?;
    } else {
        print(findings.as_text(&bench, &scene))?;
        finish("", "nightsplat bench --tune");
    }
    Ok(findings.checked.agree()?)
}

/// Times every tile and strips, and prints.
fn tune(bench: &Bench, sizes: &[[u32; 2]], as_json: bool) -> Result<()> {
    let tuning = TuningTimings::measure(bench, sizes)?;
    if as_json {
        return Ok(print(format_args!("{:#}", tuning.as_json(bench)))?);
    }
    for table in tuning.tables() {
        print(table)?;
    }
    if !bench.gpu.properties().has_pipeline_statistics {
        print("registers and spills: not reported by the driver")?;
    }
    let tile = |TunedTile { channels, tile, sorting }: &TunedTile| {
        format!("{tile} at {channels} channels, {sorting}")
    };
    let strips = tuning.fastest.ssim_strips.map(|strips| format!("{strips} strips for SSIM"));
    let fastest =
        tuning.fastest.tiles.iter().map(tile).chain(strips).collect::<Vec<_>>().join(", ");
    match &tuning.file {
        Some(_) => print(format_args!("fastest: {fastest}"))?,
        None => print(format_args!("fastest: {fastest}; not stored, as {TUNE_VARIABLE} is off"))?,
    }
    let wrote = tuning.file.map(|file| file.display().to_string()).unwrap_or_default();
    finish(&wrote, "nightsplat train photos --out run");
    Ok(())
}
