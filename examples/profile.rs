//! The times of the passes of a training step: `cargo run --release --example profile -- DATASET DOWNSCALE STEPS`.
//!
//! Trains for STEPS steps, then prints the milliseconds of each kernel, the median of nine steps.

use std::io::Write;

use nightsplat::{Dataset, DeviceChoice, Gpu, PassTime, TrainConfig, Trainer};

/// Measured steps.
const REPEATS: u64 = 9;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [path, downscale, steps] = arguments.as_slice() else {
        return Err("usage: profile DATASET DOWNSCALE STEPS".into());
    };
    let steps: u64 = steps.parse()?;
    let mut config = TrainConfig {
        downscale: downscale.parse()?,
        steps: steps + REPEATS,
        ..TrainConfig::bare()
    };
    config.schedule.resolution_steps = Some([0, 0]);
    let gpu = Gpu::new(&DeviceChoice::Best)?;
    let dataset = Dataset::load(path, &config.load_options())?;
    let mut trainer = Trainer::new(&gpu, config, &dataset)?;
    while trainer.steps_done() < steps {
        trainer.advance(steps)?;
    }
    let repeats: Vec<Vec<PassTime>> =
        (0..REPEATS).map(|_| trainer.profile_step()).collect::<Result<_, _>>()?;

    let mut kernels: Vec<(&str, f64)> = vec![];
    for (i, pass) in repeats[0].iter().enumerate() {
        let mut times: Vec<f64> = repeats.iter().map(|passes| passes[i].milliseconds).collect();
        times.sort_by(f64::total_cmp);
        let median = times[times.len() / 2];
        match kernels.iter_mut().find(|(name, _)| *name == pass.name) {
            Some((_, sum)) => *sum += median,
            None => kernels.push((pass.name, median)),
        }
    }
    let mut out = std::io::stdout().lock();
    for (name, milliseconds) in &kernels {
        writeln!(out, "{name:24} {milliseconds:8.3}")?;
    }
    let total: f64 = kernels.iter().map(|(_, milliseconds)| milliseconds).sum();
    writeln!(out, "{total:.2} ms with {} Gaussians", trainer.gaussian_count())?;
    Ok(())
}
