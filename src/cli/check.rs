//! `nightsplat check`: compares every pass of some training steps with its CPU reference.

use std::path::PathBuf;

use anyhow::Result;
use nightsplat_core::table::aligned;
use nightsplat_photographs::dataset::Dataset;
use serde_json::{Value, json};

use super::train::TrainOptions;
use super::{finish, print, word};
use crate::driver;
use crate::gpu::{CheckReport, CheckedPass, DeviceChoice, Gpu};
use crate::train::Trainer;

/// Compare every pass of some training steps with its CPU reference, and name the first number that differs.
///
/// For a device or driver that you do not trust. Slow; writes nothing. Checks one step unless --steps sets more.
#[derive(Clone, Debug, clap::Args)]
pub struct CheckArgs {
    /// Dataset, as for `train`
    pub dataset: PathBuf,
    /// Print JSON instead of a table
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub(crate) options: TrainOptions,
}

/// Checks and prints.
pub fn run(args: &CheckArgs) -> Result<()> {
    // The schedule is that of a complete run, whose first steps are checked.
    let steps = args.options.config(&args.dataset, None)?.steps;
    let steps = if args.options.gives("steps") { steps } else { 1 };
    let mut config = args.options.without("steps").config(&args.dataset, None)?;
    // Full resolution from the first step on.
    config.schedule.resolution_steps = Some([0, 0]);
    let steps = steps.min(config.steps);
    let gpu = driver::open(&config.device.parse::<DeviceChoice>()?)?;
    let dataset = Dataset::load(&config.dataset, &config.load_options())?;
    let (trainer, mut report) = gpu.checked(|| Trainer::new(&gpu, config, &dataset));
    let mut trainer = trainer?;
    while trainer.steps_done() < steps {
        let (step, passes) = trainer.check_step();
        report.extend(passes);
        step?;
    }
    if args.json {
        print(format_args!("{:#}", as_json(&gpu, &report)))?;
    } else {
        print(as_text(&gpu, &report))?;
    }
    report.agree()?;
    if !args.json {
        finish("", &format!("nightsplat train {} --out run", word(&args.dataset)));
    }
    Ok(())
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
    let verdict = match report.first_difference() {
        None => format!("{passes} passes agree with their references"),
        Some(first) => format!("the first difference is in {first}"),
    };
    format!("{}, {}\n\n{}\n{verdict}\n", properties.name, properties.driver, aligned(&rows))
}
