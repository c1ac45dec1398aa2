//! Frozen attributes: other colours on given geometry.

use crate::common::log::warnings;
use crate::common::prelude::*;
use crate::common::train::{dataset, train};

const GEOMETRY: &str = "means,quats,scales,opacities";

/// A model of a few steps, as a file.
fn day(folder: &Path) -> (PathBuf, Gaussians) {
    let (_, gaussians) =
        train(&TrainConfig { steps: 30, ..TrainConfig::bare() }, &dataset(6, [40, 30]));
    let path = folder.join("day.ply");
    gaussians.save(&path).unwrap();
    (path, gaussians)
}

fn config(init: PathBuf, freeze: &str) -> TrainConfig {
    let mut config = TrainConfig {
        steps: 40,
        init: Some(init),
        freeze: Some(freeze.parse().unwrap()),
        ..TrainConfig::bare()
    };
    // Rounds of density control would be due.
    (config.schedule.densify_after, config.schedule.densify_interval) = (5, 10);
    config
}

#[test]
fn frozen_geometry_keeps_its_bits_and_colours_learn_on_any_device() {
    let folder = Folder::empty();
    let (path, day) = day(&folder);
    let dataset = dataset(6, [40, 30]);
    for gpu in [gpu(), gpu_with(|properties| properties.is_cpu = false)] {
        for format in [StorageFormat::Single, StorageFormat::Half] {
            let mut config = config(path.clone(), GEOMETRY);
            (config.precision.rest, config.precision.moments) = (format, format);
            // The floor of the cameras would raise the scales.
            config.antialiasing.smoothing = 4.0;
            let mut trainer = Trainer::new(&gpu, config, &dataset).unwrap();
            let before = trainer.gaussians().unwrap();
            agreeing_step(&mut trainer);
            assert_eq!(trainer.trained_floats(), day.count * 59 - day.count * 11 / 4 * 4);
            let reports = advance(&mut trainer, 40);
            // Of as many steps on each of the five views.
            let loss = |steps: std::ops::Range<usize>| {
                reports[steps].iter().map(|step| step.loss).sum::<f64>()
            };
            let after = trainer.gaussians().unwrap();
            assert_eq!(after.count, day.count, "no density control");
            for (before, after) in [
                (bytes(before.means()), bytes(after.means())),
                (bytes(before.quats()), bytes(after.quats())),
                (bytes(before.log_scales()), bytes(after.log_scales())),
                (bytes(before.raw_opacities()), bytes(after.raw_opacities())),
            ] {
                assert!(before == after);
            }
            assert!(before.dc() != after.dc() && before.rest() != after.rest());
            assert!(loss(24..39) < loss(0..15), "{} {}", loss(24..39), loss(0..15));
            let gradients = trainer.gradients().unwrap();
            assert!(gradients.means().iter().all(|mean| *mean == Vec3::ZERO), "not written");
        }
    }
}

/// More Gaussians than a binding holds, the last batch with an odd number.
#[test]
fn frozen_geometry_in_batches_gives_the_bits_of_one_batch_and_resumes() {
    let folder = Folder::empty();
    let dataset = Dataset { points: vec![], ..dataset(6, [40, 30]) };
    let mut random = TrainConfig { steps: 2, random_points: 4205, ..TrainConfig::bare() };
    // Small Gaussians, which intersect few tiles: a binding holds the intersections of all of them.
    random.start.scale = 0.1;
    let path = folder.join("day.ply");
    train(&random, &dataset).1.save(&path).unwrap();
    let (whole, little) =
        (gpu(), gpu_with(|properties| properties.max_storage_buffer_range = 1 << 19));
    let new = |gpu: &Gpu| {
        let mut config = config(path.clone(), GEOMETRY);
        config.tile = Some([16, 16].into());
        Trainer::new(gpu, config, &dataset).unwrap()
    };
    let (mut expected, mut batched) = (new(&whole), new(&little));
    let (_, report) = agreeing_step(&mut batched);
    let passes = report.passes.iter().filter(|pass| pass.kernel == "project_backward");
    assert!(passes.count() > 1);
    for trainer in [&mut expected, &mut batched] {
        advance(trainer, 12);
    }
    let checkpoint = folder.join("checkpoint.safetensors");
    batched.save_checkpoint(&checkpoint).unwrap();
    let mut resumed = new(&whole);
    resumed.restore(&checkpoint).unwrap();
    for trainer in [&mut expected, &mut batched, &mut resumed] {
        advance(trainer, 25);
    }
    let expected = expected.gaussians().unwrap();
    assert!(batched.gaussians().unwrap() == expected);
    assert!(resumed.gaussians().unwrap() == expected);
}

fn bytes<T: bytemuck::NoUninit>(values: &[T]) -> Vec<u8> {
    bytemuck::cast_slice(values).to_vec()
}

#[test]
fn a_frozen_attribute_between_trained_ones_does_not_change() {
    let folder = Folder::empty();
    let (path, _) = day(&folder);
    let dataset = dataset(6, [40, 30]);
    let mut trainer = Trainer::new(&gpu(), config(path, "dc,scales"), &dataset).unwrap();
    let before = trainer.gaussians().unwrap();
    advance(&mut trainer, 20);
    let after = trainer.gaussians().unwrap();
    assert_eq!((before.dc(), before.log_scales()), (after.dc(), after.log_scales()));
    assert!(before.means() != after.means() && before.rest() != after.rest());
}

#[test]
fn a_model_of_another_world_is_warned_of_with_the_count() {
    let folder = Folder::empty();
    let (path, mut day) = day(&folder);
    let dataset = dataset(6, [40, 30]);
    let new = |path: PathBuf| {
        warnings(|| drop(Trainer::new(&gpu(), config(path, GEOMETRY), &dataset).unwrap()))
    };
    assert!(!new(path).contains("out of sight"));
    day.means_mut().iter_mut().for_each(|mean| *mean += 1e4);
    let elsewhere = folder.join("elsewhere.ply");
    day.save(&elsewhere).unwrap();
    let warned = new(elsewhere);
    let count = format!("{0} of {0} Gaussians are out of sight of every camera", day.count);
    assert!(warned.contains(&count) && warned.contains("elsewhere.ply"), "{warned}");
}

#[test]
fn colours_on_frozen_geometry_are_scored_every_fifty_steps() {
    let folder = Folder::empty();
    let (path, _) = day(&folder);
    let config = TrainConfig { steps: 110, ..config(path, GEOMETRY) };
    let mut dataset = dataset(6, [40, 30]);
    dataset.views[1].split = Split::HeldOut;
    let mut trainer = Trainer::new(&gpu(), config, &dataset).unwrap();
    while trainer.steps_done() < 110 && !trainer.has_ended() {
        trainer.advance(110).unwrap();
    }
    let scored: Vec<u64> = trainer.held_out_scores().map(|(step, _)| step).collect();
    assert_eq!(scored[..2], [50, 100]);
}
