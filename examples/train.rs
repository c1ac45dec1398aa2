//! Trains on a small dataset from a program: `cargo run --release --example train -- FOLDER`.
//!
//! Writes the dataset to FOLDER/set, trains into FOLDER/run and prints the events of the run.

#![expect(clippy::print_stdout, reason = "the example prints the events of the run")]

use std::path::PathBuf;

use nightsplat::run::{self, After, Event, IfExists, Metric};
use nightsplat::synthetic::{self, SyntheticOptions};
use nightsplat::{Dataset, DeviceChoice, Gpu, ToneCurve, ToneSettings, TrainConfig};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder: PathBuf = std::env::args_os().nth(1).ok_or("usage: train FOLDER")?.into();
    let set = folder.join("set");
    synthetic::write(&set, &SyntheticOptions { width: 80, height: 60, ..Default::default() })?;

    let config = TrainConfig {
        dataset: set,
        steps: 200,
        eval_every: 100,
        tone: ToneSettings::new(ToneCurve::Ase),
        ..TrainConfig::default()
    };
    let gpu = Gpu::new(&DeviceChoice::Best)?;
    let dataset = Dataset::load(&config.dataset, &config.load_options())?;
    run::train(
        &gpu,
        &config,
        &dataset,
        &folder.join("run"),
        IfExists::Replace,
        |event| match event {
            Event::Started { steps, .. } => println!("{steps} steps"),
            Event::Step(report) if report.step.is_multiple_of(50) => {
                println!("step {}, view {}: loss {:.4}", report.step, report.view, report.loss);
            }
            Event::Evaluated { step, evaluation } => {
                if let Some(psnr) = evaluation.mean(Metric::Psnr, After::Model) {
                    let views = evaluation.views().len();
                    println!("step {step}: {psnr:.2} dB on {views} test views");
                }
            }
            Event::Finished(trained) => {
                let gaussians = trained.trainer.gaussian_count();
                println!("{gaussians} Gaussians in {:.1} s", trained.spent.seconds);
            }
            _ => {}
        },
    )?;
    Ok(())
}
