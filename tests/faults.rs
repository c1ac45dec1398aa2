//! Memory that runs out and devices that are lost, at every place where that can be: nothing is lost that was saved, and no
//! run says that it is done where it is not.
#![cfg(feature = "io")]
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::collections::BTreeMap;
use std::path::Path;

use nightsplat::Error;
use nightsplat::dataset::Dataset;
use nightsplat::gpu::testing::{allocations, fail_allocation, lose_at_submission};
use nightsplat::gpu::{DeviceChoice, Gpu};
use nightsplat::run::{self, Event, HeldRun};
use nightsplat::train::{ModelConfig, Part, TrainConfig};

mod common;
use common::train::dataset;

fn gpu() -> Gpu {
    let choice = std::env::var("NIGHTSPLAT_DEVICE").unwrap_or_default();
    Gpu::with_validation(&choice.parse::<DeviceChoice>().unwrap()).unwrap()
}

/// Everything that allocates on the way, in a few steps: growth, what rises with the SH degree, networks, checkpoints.
fn config() -> TrainConfig {
    let mut config = TrainConfig {
        steps: 14,
        sh_degree: 1,
        random_points: 300,
        checkpoint_every: 6,
        checkpoint_minutes: 0.0,
        eval_every: 7,
        ..TrainConfig::default()
    };
    config.model = ModelConfig::default();
    config.model.set_parts(&[Part::Structure]);
    config.schedule.densify_after = 2;
    config.schedule.densify_interval = 4;
    config.schedule.sh_degree_interval = 5;
    config.schedule.resolution_steps = [0, 0];
    config.density.gradient_threshold = 1e-7;
    config
}

/// Trains into `out`; the error, where there is one, and the last step that was reported.
fn train(
    gpu: &Gpu,
    config: &TrainConfig,
    dataset: &Dataset,
    out: &Path,
    held: HeldRun,
) -> (Option<Error>, u64) {
    let mut last = 0;
    let trained = run::train(gpu, config, dataset, out, held, |event| {
        if let Event::Step(report) = event {
            last = report.step;
        }
    });
    (trained.err(), last)
}

#[test]
fn memory_that_runs_out_anywhere_leaves_a_checkpoint_and_no_finished_run() {
    let (gpu, dataset, config) = (gpu(), dataset(5, [24, 20]), config());
    let folder = tempfile::tempdir().unwrap();
    let straight = folder.path().join("straight");
    fail_allocation(&gpu, 0);
    assert!(train(&gpu, &config, &dataset, &straight, HeldRun::Refuse).0.is_none());
    let names = allocations(&gpu);
    let expected = std::fs::read(straight.join("model.ply")).unwrap();
    // The first and the last of every name.
    let mut sites = BTreeMap::<&str, [usize; 2]>::new();
    for (index, name) in names.iter().enumerate() {
        sites.entry(name).or_insert([index; 2])[1] = index;
    }
    let mut numbers: Vec<usize> = sites.into_values().flatten().collect();
    numbers.sort_unstable();
    numbers.dedup();
    eprintln!("{} allocations, {} sites", names.len(), numbers.len());
    let begin = std::time::Instant::now();
    let mut resumed = 0;
    for index in numbers {
        let (name, out) = (&names[index], folder.path().join(format!("run{index}")));
        fail_allocation(&gpu, index as u64 + 1);
        let (error, last) = train(&gpu, &config, &dataset, &out, HeldRun::Refuse);
        fail_allocation(&gpu, 0);
        let error = error.unwrap_or_else(|| panic!("{name} ({index}): the run says it is done"));
        assert_eq!(error.exit_code(), 4, "{name} ({index}): {error}");
        for sign in ["done.json", "metrics.json"] {
            assert!(!out.join(sign).exists(), "{name} ({index}): {sign}");
        }
        let is_saved = out.join("checkpoint.safetensors").exists();
        assert!(is_saved || last == 0, "{name} ({index}): {last} steps are lost");
        if is_saved {
            let (error, _) = train(&gpu, &config, &dataset, &out, HeldRun::Resume);
            assert!(error.is_none(), "{name} ({index}): {error:?}");
            let model = std::fs::read(out.join("model.ply")).unwrap();
            assert!(model == expected, "{name} ({index}): another model");
            resumed += 1;
        }
    }
    eprintln!("{resumed} resumed, {:?}", begin.elapsed());
    assert!(resumed > 5);
}

#[test]
fn a_device_that_is_lost_anywhere_leaves_the_last_checkpoint_to_go_on_from() {
    let (dataset, config) = (dataset(5, [24, 20]), config());
    let folder = tempfile::tempdir().unwrap();
    let straight = folder.path().join("straight");
    assert!(train(&gpu(), &config, &dataset, &straight, HeldRun::Refuse).0.is_none());
    let expected = std::fs::read(straight.join("model.ply")).unwrap();
    let mut resumed = 0;
    for number in [1, 20, 40, 60, 70, 80, 90] {
        let out = folder.path().join(format!("run{number}"));
        let lost = gpu();
        lose_at_submission(&lost, number);
        let (error, last) = train(&lost, &config, &dataset, &out, HeldRun::Refuse);
        drop(lost);
        let Some(error) = error else { continue };
        assert!(matches!(error, Error::DeviceLost { .. }), "{number}: {error}");
        assert_eq!(error.exit_code(), 4);
        assert!(!out.join("done.json").exists() && !out.join("metrics.json").exists());
        eprintln!("{number}: {last} {error}");
        if out.join("config.toml").exists() {
            let (error, _) = train(&gpu(), &config, &dataset, &out, HeldRun::Resume);
            assert!(error.is_none(), "{number}: {error:?}");
            assert!(std::fs::read(out.join("model.ply")).unwrap() == expected, "{number}");
            resumed += 1;
        }
    }
    assert!(resumed > 1);
}
