//! The same command gives the same bits: under any load, for any submission, inspection and interruption of the steps,
//! and according to the ledger of this driver.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use nightsplat::train::Background;

use crate::common::prelude::*;
use crate::common::train::dataset;
use crate::common::{fixture, not_run};

const REPETITIONS: usize = 25;
const STEPS: u64 = 16;

fn config() -> TrainConfig {
    let mut config =
        TrainConfig { steps: STEPS, background: Background::Random, ..TrainConfig::bare() };
    config.schedule.densify_after = 5;
    config.schedule.densify_interval = 6;
    config.schedule.sh_degree_interval = 5;
    config.max_gaussians = 1500;
    config.random_points = 500;
    config
}

/// Keeps the cores busy as long as it lives.
struct Load {
    stops: Arc<AtomicBool>,
    threads: Vec<JoinHandle<u64>>,
}

impl Load {
    fn new() -> Self {
        let stops = Arc::new(AtomicBool::new(false));
        let work = |stops: Arc<AtomicBool>| {
            move || {
                let mut turns = 0u64;
                while !stops.load(Ordering::Relaxed) {
                    turns = std::hint::black_box(turns.wrapping_mul(3).wrapping_add(1));
                }
                turns
            }
        };
        let threads = (0..2).map(|_| std::thread::spawn(work(stops.clone()))).collect();
        Self { stops, threads }
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        self.stops.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            thread.join().unwrap();
        }
    }
}

/// One of several ways to the end, from a checkpoint.
fn trained(repetition: usize, [one, other]: &mut [Trainer; 2], folder: &Path) -> Gaussians {
    let _load = (repetition % 3 == 1).then(Load::new);
    let checkpoint = folder.join("checkpoint.safetensors");
    let mut trainer = one;
    trainer.restore(&folder.join("begin.safetensors")).unwrap();
    trainer.set_batching(1 + repetition % 3, [None, Some(1), Some(3), Some(64)][repetition % 4]);
    match repetition % 5 {
        1 => {
            // A profiled step is like others; it may have to be repeated with more memory.
            advance(trainer, 3);
            trainer.profile_step().unwrap();
        }
        2 => {
            let interval = 1 + repetition as u64 % 7;
            while trainer.steps_done() < STEPS {
                advance(trainer, (trainer.steps_done() + interval).min(STEPS));
                trainer.save_checkpoint(&checkpoint).unwrap();
            }
        }
        3 => {
            advance(trainer, repetition as u64 % STEPS);
            trainer.save_checkpoint(&checkpoint).unwrap();
            trainer = other;
            trainer.restore(&checkpoint).unwrap();
        }
        4 if repetition == 4 => {
            advance(trainer, 2);
            trainer.check_step().0.unwrap();
        }
        _ => {}
    }
    advance(trainer, STEPS);
    trainer.gaussians_in_frame().unwrap()
}

#[test]
fn twenty_five_runs_loaded_profiled_resumed_and_differently_submitted_give_the_same_bits() {
    let (dataset, folder) = (dataset(5, [24, 18]), tempfile::tempdir().unwrap());
    let mut trainers = [(); 2].map(|()| Trainer::new(&gpu(), config(), &dataset).unwrap());
    trainers[0].save_checkpoint(&folder.path().join("begin.safetensors")).unwrap();
    let first = trained(0, &mut trainers, folder.path());
    for repetition in 1..REPETITIONS {
        let again = trained(repetition, &mut trainers, folder.path());
        assert!(again == first, "repetition {repetition} differs");
    }
}

/// The name of a device and its driver in file names.
fn file_name(device: &str, driver: &str) -> String {
    let text = format!("{device} {driver}");
    let keep = |c: char| if c.is_ascii_alphanumeric() || c == '.' { c } else { '-' };
    let name: String = text.chars().map(keep).collect();
    name.split('-').filter(|part| !part.is_empty()).collect::<Vec<_>>().join("-") + ".csv"
}

/// Keeps the first points of a COLMAP model: if there were more points than Gaussians, training would sample them.
fn keep_first_points(path: &Path, count: usize) {
    let text = fs::read_to_string(path).unwrap();
    let (comments, points): (Vec<&str>, Vec<&str>) =
        text.lines().partition(|line| line.starts_with('#'));
    assert!(points.len() >= count);
    let kept = comments.into_iter().chain(points.into_iter().take(count));
    fs::write(path, kept.map(|line| format!("{line}\n")).collect::<String>()).unwrap();
}

/// A tiny scene, trained with density control, in a folder whose `run` has `hashes.csv`, `train.csv` and
/// `metrics.json`.
fn tiny_run() -> Folder {
    let folder = Folder::empty();
    nightsplat_synth::write(folder.join("set"), &small_set(8, [32, 24], 1)).unwrap();
    keep_first_points(&folder.join("set/colmap_sparse/0/points3D.txt"), 2000);
    folder.succeed(
        "train @set --out @run --plan none --model plain --curve ap3 --steps 60 --hash-every 20 --set tile=[16,8] \
         --set schedule.densify_after=10 --set schedule.densify_interval=10 --max-gaussians 2000 --background black \
         --set density.depth_seeding=0 --set precision.rest=32 --set precision.moments=32 \
         --set schedule.cooldown_steps=0",
    );
    folder
}

#[test]
fn a_tiny_scene_trains_to_the_ledger_of_this_driver() {
    let properties = gpu().properties().clone();
    let name = file_name(&properties.name, &properties.driver);
    let ledger = fixture("ledger").join(&name);
    let Ok(expected) = fs::read_to_string(&ledger) else {
        not_run("ledger", format_args!("this driver has none, tests/fixtures/ledger/{name}"));
        return;
    };
    let actual = tiny_run().text("run/hashes.csv");
    assert_eq!(actual, expected, "where this is meant, it belongs into {}", ledger.display());
}

/// Devices round differently, and Adam, which divides by the magnitude of gradients, amplifies that. Between two
/// versions of lavapipe and `SwiftShader`, the losses of 60 steps differ by up to 8e-4, the scores by up to 0.007 dB.
#[test]
fn every_device_trains_a_tiny_scene_to_the_same_losses_and_score() {
    const FIRST: f64 = 1e-5;
    const LOSS: f64 = 5e-3;
    const SCORE: f64 = 0.05;
    let folder = tiny_run();
    let losses = |path: PathBuf| -> Vec<f64> {
        let text = fs::read_to_string(path).unwrap();
        let column = text.lines().next().unwrap().split(',').position(|name| name == "loss");
        let loss = |line: &str| line.split(',').nth(column.unwrap()).unwrap().parse().unwrap();
        text.lines().skip(1).map(loss).collect()
    };
    let expected = losses(fixture("devices/losses.csv"));
    let actual = losses(folder.join("run/train.csv"));
    assert_eq!(actual.len(), expected.len());
    for (step, (actual, expected)) in (1..).zip(actual.into_iter().zip(expected)) {
        let bound = if step == 1 { FIRST } else { LOSS };
        assert!((actual / expected - 1.0).abs() <= bound, "step {step}: {actual}, not {expected}");
    }
    let psnr = folder.json("run/metrics.json")["mean"]["psnr"].as_f64().unwrap();
    assert!((psnr - 23.844).abs() <= SCORE, "{psnr} dB");
}
