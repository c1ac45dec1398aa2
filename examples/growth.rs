//! Scaling of time and memory: `cargo run --release --example growth -- [WIDTH HEIGHT GAUSSIANS]`.
//!
//! One quantity changes at a time: Gaussians, pixels and channels of the scene of `nightsplat bench` (512 384 20000 by
//! default), photographs and points of a capture. It prints milliseconds and peak device memory for each value, and the
//! exponents of a fitted power law for each quantity.

use std::error::Error as StdError;
use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

use glam::DVec3;
use nightsplat::bench::scene::{self, BenchScene};
use nightsplat::gpu::{DeviceChoice, Gpu, PassTime};
use nightsplat::splats::device::Upload;
use nightsplat::splats::render::{
    GradientNorm, Gradients, RenderOptions, RenderSettings, Renderer,
};
use nightsplat::train::{TrainConfig, Trainer};
use nightsplat::{Error, Result};
use nightsplat_core::random::Stream;
use nightsplat_diagnose::Diagnosis;
use nightsplat_models::gaussians::{Features, MAX_SH_DEGREE, Shape};
use nightsplat_photographs::dataset::{Dataset, Point};
use nightsplat_synth::SyntheticOptions;
use tempfile::TempDir;

/// Factors of the scene's number of Gaussians.
const GAUSSIANS: [f64; 5] = [0.5, 1.5, 5.0, 12.5, 25.0];
const PIXELS: [f64; 6] = [0.5, 1.5, 5.0, 10.0, 20.0, 40.0];

/// 3 to 11 channels, one more feature each time.
const CHANNELS: [Features; 5] = [
    Features::NONE,
    Features { depth: true, ..Features::NONE },
    Features { depth: true, structure: true, ..Features::NONE },
    Features { illumination: false, ..Features::ALL },
    Features::ALL,
];

/// Photographs of a capture.
const VIEWS: [usize; 4] = [16, 48, 144, 432];

/// Factors of the capture's own number of points.
const POINTS: [usize; 4] = [1, 4, 16, 64];

/// Timed runs of a step, after a warm-up; the fastest counts.
const REPEATS: usize = 5;

/// Runs go on for this time: the clocks of a GPU fall while the host makes a scene, to a sixth, and rise again within
/// some hundred milliseconds.
const WARM: Duration = Duration::from_millis(400);

fn main() -> std::result::Result<(), Box<dyn StdError>> {
    let arguments: Vec<u32> = std::env::args()
        .skip(1)
        .map(|argument| argument.parse())
        .collect::<std::result::Result<_, _>>()?;
    let [width, height, gaussians] = match arguments.as_slice() {
        [] => [512, 384, 20_000],
        &[width, height, gaussians] => [width, height, gaussians],
        _ => return Err("usage: growth [WIDTH HEIGHT GAUSSIANS]".into()),
    };
    let gpu = Gpu::new(&DeviceChoice::Best)?;
    let size = [width, height];
    let grown = |by: f64| size.map(|side| (f64::from(side) * by.sqrt()).round() as u32);
    let count = |by: f64| ((f64::from(gaussians) * by).round() as usize).max(1);
    print_axis("Gaussians", "step", &GAUSSIANS, |by| {
        (count(by) as f64, step(&gpu, size, count(by)))
    })?;
    print_axis("pixels", "step", &PIXELS, |by| {
        let [width, height] = grown(by);
        (f64::from(width) * f64::from(height), step(&gpu, [width, height], count(1.0)))
    })?;
    print_axis("channels", "rasteriser", &CHANNELS, |features| {
        (features.channels() as f64, rasteriser(&gpu, size, count(1.0), features))
    })?;
    print_axis("photographs", "reading and placing", &VIEWS, |views| {
        (views as f64, reading(&gpu, views))
    })?;
    let folder = capture(VIEWS[0])?;
    let config = config(folder.path());
    let dataset = Dataset::load(folder.path(), &config.load_options())?;
    print_axis("points", "placing", &POINTS, |times| {
        let points = repeated(&dataset.points, times);
        (points.len() as f64, placing(&gpu, &config, &Dataset { points, ..dataset.clone() }))
    })
}

/// Milliseconds and peak device memory in bytes, measured since the last call of `Gpu::reset_peak_memory`.
type Measured = Result<(f64, u64)>;

/// A training step of the plain model.
fn step(gpu: &Gpu, [width, height]: [u32; 2], gaussians: usize) -> Measured {
    gpu.reset_peak_memory();
    let scene = BenchScene::new(width, height, gaussians);
    let mut trainer = scene::plain(gpu, &scene, &TrainConfig::bare().precision)?;
    Ok((least(|| trainer.profile_step())?, gpu.peak_memory()))
}

/// Forward and backward pass of the rasteriser; other passes do not depend on the number of channels, unless a part of
/// the model needs them.
fn rasteriser(gpu: &Gpu, [width, height]: [u32; 2], count: usize, features: Features) -> Measured {
    const OPTIONS: RenderOptions = RenderOptions { sh_degree: 3, background: [0.0; 3] };
    gpu.reset_peak_memory();
    let shape = Shape { sh_degree: MAX_SH_DEGREE, features };
    let camera = scene::camera(width, height);
    let gaussians = scene::gaussians(&camera, count, shape).upload(gpu)?;
    let mut renderer = Renderer::new(gpu, RenderSettings { shape, ..RenderSettings::default() })?;
    renderer.reserve(count, [&camera])?;
    renderer.render_channels(&gaussians, &camera, &OPTIONS)?;
    let values = features.channels() * width as usize * height as usize;
    let d_render = gpu.buffer("d_render", &vec![1e-3; values])?;
    let mut parameters = gpu.zeros("gradients", gaussians.layout.floats().total())?;
    let mut grad_norm_sums = gpu.zeros("grad_norm_sums", count)?;
    let mut visit_counts = gpu.zeros("visit_counts", count)?;
    let milliseconds = least(|| {
        gpu.profile("growth", |pass| {
            renderer.forward(pass, &gaussians, &camera, &OPTIONS)?;
            let gradients = Gradients {
                parameters: &mut parameters,
                grad_norm_sums: &mut grad_norm_sums,
                visit_counts: &mut visit_counts,
            };
            let norm = GradientNorm::default();
            let drawn = gaussians.slice();
            renderer.backward(pass, drawn, &camera, &OPTIONS, norm, &d_render, gradients)
        })
    })?;
    Ok((milliseconds, gpu.peak_memory()))
}

/// From the files of a capture of small photographs to the first step.
fn reading(gpu: &Gpu, views: usize) -> Measured {
    let folder = capture(views)?;
    let config = config(folder.path());
    let begin = Instant::now();
    let (dataset, _) = Diagnosis::load(folder.path(), &config.load_options())?;
    let loaded = begin.elapsed().as_secs_f64() * 1e3;
    let (milliseconds, bytes) = placing(gpu, &config, &dataset)?;
    Ok((loaded + milliseconds, bytes))
}

/// The first Gaussians of a capture.
fn placing(gpu: &Gpu, config: &TrainConfig, dataset: &Dataset) -> Measured {
    gpu.reset_peak_memory();
    let begin = Instant::now();
    Trainer::new(gpu, config.clone(), dataset)?;
    Ok((begin.elapsed().as_secs_f64() * 1e3, gpu.peak_memory()))
}

/// The points repeated several times, side by side.
fn repeated(points: &[Point], times: usize) -> Vec<Point> {
    let near = |at: usize| {
        let draws = Stream::new(7, at as u64);
        let beside = DVec3::new(draws.normal(0), draws.normal(1), draws.normal(2));
        let Point { position, views } = &points[at % points.len()];
        Point { position: *position + 0.01 * beside, views: views.clone() }
    };
    (0..times * points.len()).map(near).collect()
}

/// A capture of photographs so small that pixels cost little.
fn capture(views: usize) -> Result<TempDir> {
    let folder = tempfile::tempdir()
        .map_err(|error| Error::Usage(format!("a temporary folder cannot be created: {error}")))?;
    let options = SyntheticOptions { views, width: 48, height: 36, ..SyntheticOptions::default() };
    nightsplat_synth::write(folder.path(), &options)?;
    Ok(folder)
}

fn config(dataset: &Path) -> TrainConfig {
    TrainConfig { dataset: dataset.to_owned(), random_points: 1, ..TrainConfig::default() }
}

/// The shortest total time of all passes, in milliseconds.
fn least(mut profile: impl FnMut() -> Result<Vec<PassTime>>) -> Result<f64> {
    profile()?;
    let (begin, mut least, mut runs) = (Instant::now(), f64::INFINITY, 0);
    while runs < REPEATS || begin.elapsed() < WARM {
        least = least.min(profile()?.iter().map(|time| time.milliseconds).sum());
        runs += 1;
    }
    Ok(least)
}

/// Measures and prints each value of a quantity, or an error if it does not fit the device.
fn print_axis<T: Copy>(
    quantity: &str,
    timed: &str,
    values: &[T],
    mut measure: impl FnMut(T) -> (f64, Measured),
) -> std::result::Result<(), Box<dyn StdError>> {
    let mut out = std::io::stdout().lock();
    let timed = format!("{timed}, ms");
    writeln!(out, "{quantity:12} {timed:>24} {:>12}", "memory, MB")?;
    let mut measured = vec![];
    for &value in values {
        match measure(value) {
            (value, Ok((milliseconds, bytes))) => {
                writeln!(out, "{value:12} {milliseconds:24.2} {:12.1}", bytes as f64 / 1e6)?;
                measured.push([value, milliseconds, bytes as f64].map(f64::ln));
            }
            (
                value,
                Err(
                    error @ (Error::OutOfMemory { .. }
                    | Error::BufferTooLarge { .. }
                    | Error::TileLimit { .. }
                    | Error::Usage(_)),
                ),
            ) => writeln!(out, "{value:12} {error}")?,
            (_, Err(error)) => return Err(error.into()),
        }
    }
    let [time, memory] = [1, 2].map(|of| slope(&measured, of));
    writeln!(out, "{:12} {time:24.2} {memory:12.2}\n", "exponent")?;
    Ok(())
}

/// The slope of a line through the logarithms, by least squares; NaN for fewer than two values.
fn slope(logs: &[[f64; 3]], of: usize) -> f64 {
    let mean = |of: usize| logs.iter().map(|log| log[of]).sum::<f64>() / logs.len() as f64;
    let (x, y) = (mean(0), mean(of));
    let across: f64 = logs.iter().map(|log| (log[0] - x) * (log[of] - y)).sum();
    across / logs.iter().map(|log| (log[0] - x).powi(2)).sum::<f64>()
}
