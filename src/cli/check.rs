//! `nightsplat check`: training steps on one's own data and device, every pass against its CPU reference.

use std::io::Write;
use std::path::PathBuf;

use anyhow::Result;
use serde_json::{Value, json};

use super::table;
use super::train::TrainOptions;
use crate::gpu::{CheckReport, CheckedPass, DeviceChoice, Gpu};
use crate::photographs::dataset::Dataset;
use crate::train::Trainer;

/// Compare every pass of some training steps with its CPU reference, and name the first number that differs.
///
/// Slow, and nothing is written: for a device or driver that one does not trust. `--steps` says how many [default here: 1].
#[derive(Clone, Debug, clap::Args)]
pub struct CheckArgs {
    /// The folder with the photographs
    pub dataset: PathBuf,
    /// Print JSON instead of a table: device, driver, passes, and the first difference
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub(crate) options: TrainOptions,
}

/// Checks and prints.
///
/// # Errors
/// [`crate::Error::Disagrees`] where something differs, or whatever keeps a run from training.
pub fn run(args: &CheckArgs) -> Result<()> {
    // The schedule is that of a whole run; so many of its steps are checked.
    let steps = args.options.config(&args.dataset, None)?.steps;
    let steps = if args.options.gives("steps") { steps } else { 1 };
    let mut config = args.options.without("steps").config(&args.dataset, None)?;
    // Sizes that training comes to, from the first step on.
    config.schedule.resolution_steps = [0, 0];
    let steps = steps.min(config.steps);
    let gpu = Gpu::new(&config.device.parse::<DeviceChoice>()?)?;
    let dataset = Dataset::load(&config.dataset, &config.load_options())?;
    let (trainer, mut report) = gpu.checked(|| Trainer::new(&gpu, config, &dataset));
    let mut trainer = trainer?;
    while trainer.steps_done() < steps {
        let (step, passes) = trainer.check_step();
        report.extend(passes);
        step?;
    }
    let mut out = std::io::stdout().lock();
    if args.json {
        writeln!(out, "{:#}", as_json(&gpu, &report))?;
    } else {
        write!(out, "{}", as_text(&gpu, &report))?;
    }
    Ok(report.agree()?)
}

fn as_json(gpu: &Gpu, report: &CheckReport) -> Value {
    let pass = |pass: &CheckedPass| {
        json!({
            "recording": pass.recording,
            "kernel": pass.kernel,
            "error": pass.error,
            "difference": pass.difference.as_ref().map(ToString::to_string),
        })
    };
    json!({
        "device": gpu.properties().name,
        "driver": gpu.properties().driver,
        "passes": report.passes.iter().map(pass).collect::<Vec<_>>(),
        "first_difference": report.first_difference().map(|first| json!({
            "pass": first.pass,
            "kernel": first.kernel,
            "buffer": first.buffer,
            "index": first.index,
            "device": first.device,
            "reference": first.reference,
            "bound": first.bound,
        })),
    })
}

fn as_text(gpu: &Gpu, report: &CheckReport) -> String {
    let mut rows = vec![["pass", "recording", "largest error / bound"].map(str::to_owned).to_vec()];
    rows.extend(report.passes.iter().map(|pass| {
        let error = pass.error.map_or_else(|| "not compared".to_owned(), |e| format!("{e:.3}"));
        vec![pass.kernel.to_owned(), pass.recording.clone(), error]
    }));
    let (properties, passes) = (gpu.properties(), report.passes.len());
    let end = match report.first_difference() {
        None => format!("{passes} passes agree with their references"),
        Some(first) => format!("the first difference is in {first}"),
    };
    format!("{}, {}\n\n{}\n{end}\n", properties.name, properties.driver, table::aligned(&rows))
}
