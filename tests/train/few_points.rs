//! Datasets with few points: random points are added, and Gaussians at the depths that the first steps found.

use nightsplat::train::{DensityConfig, Part};
use nightsplat_photographs::image::Mask;

use crate::common::prelude::*;
use crate::common::train::train;

/// All points, which are on the surfaces, and a dataset with `points` of them.
fn dataset(points: usize) -> (Vec<DVec3>, Dataset) {
    let mut dataset = crate::common::train::dataset(9, [64, 48]);
    let all = dataset.points.iter().map(|point| point.position).collect();
    let apart = dataset.points.len() / points.max(1);
    dataset.points = dataset.points.into_iter().step_by(apart.max(1)).take(points).collect();
    (all, dataset)
}

/// The first of two rounds of density control seeds Gaussians by depth.
fn config() -> TrainConfig {
    let mut config = TrainConfig { steps: 60, ..TrainConfig::bare() };
    config.schedule.densify_after = 8;
    config.schedule.densify_interval = 20;
    config.density.depth_seeding = 300;
    config
}

/// The mean distance of Gaussians from the nearest of `points`.
fn distance(gaussians: impl Iterator<Item = DVec3>, points: &[DVec3]) -> f64 {
    let nearest =
        |mean: DVec3| points.iter().map(|point| point.distance(mean)).fold(f64::INFINITY, f64::min);
    let distances: Vec<f64> = gaussians.map(nearest).collect();
    distances.iter().sum::<f64>() / distances.len() as f64
}

fn means(gaussians: &Gaussians) -> impl Iterator<Item = DVec3> {
    gaussians.means().iter().map(|mean| mean.as_dvec3())
}

#[test]
fn depth_seeding_adds_the_requested_gaussians_closer_to_the_surfaces_than_random_ones() {
    let (surface, dataset) = dataset(20);
    let mut trainer = Trainer::new(&gpu(), config(), &dataset).unwrap();
    // A tenth, with random points added to the twenty.
    assert_eq!(trainer.gaussian_count(), 30);
    let first = trainer.gaussians().unwrap();
    let estimate = trainer.memory_estimate().unwrap();
    assert!(estimate.peak_gaussians >= 300, "{estimate:?}");
    advance(&mut trainer, 19);
    assert_eq!(trainer.gaussian_count(), 30);
    advance(&mut trainer, 20);
    assert_eq!(trainer.gaussian_count(), 300);
    let filled = trainer.gaussians().unwrap();
    let [random, added] =
        [distance(means(&first).skip(20), &surface), distance(means(&filled).skip(30), &surface)];
    assert!(added < 0.5 * random, "{added} {random}");
    advance(&mut trainer, 60);
    assert!(trainer.gaussian_count() >= 300);
}

#[test]
fn scores_are_better_after_the_same_number_of_steps() {
    let (_, dataset) = dataset(20);
    let loss = |fill| {
        let mut config = config();
        config.density.depth_seeding = fill;
        let (reports, _) = train(&config, &dataset);
        reports[45..].iter().map(|report| report.loss).sum::<f64>() / 15.0
    };
    let [with, without] = [loss(300), loss(0)];
    assert!(with < 0.9 * without, "{with} {without}");
}

#[test]
fn there_is_no_seeding_with_many_points_the_papers_control_or_a_setting_of_zero() {
    let with = |fill: usize, density: DensityConfig, points: usize| {
        let config = TrainConfig {
            steps: 40,
            density: DensityConfig { depth_seeding: fill, ..density },
            ..config()
        };
        train(&config, &dataset(points).1).1
    };
    let default = DensityConfig::default();
    assert!(with(300, default.clone(), 31) == with(0, default.clone(), 31));
    assert!(with(300, default.clone(), 30) != with(0, default, 30));
    let paper = with(300, DensityConfig::paper(), 20);
    assert!(paper == with(0, DensityConfig::paper(), 20) && paper.count < 200);
}

#[test]
fn small_views_have_at_most_one_gaussian_for_eight_pixels() {
    let mut config = TrainConfig { steps: 40, ..config() };
    config.density.depth_seeding = 5_000;
    let mut trainer = Trainer::new(&gpu(), config, &dataset(20).1).unwrap();
    assert_eq!(trainer.gaussian_count(), 500);
    advance(&mut trainer, 20);
    // There are already more: the round is an ordinary one.
    assert!(trainer.gaussian_count() < 1000);
    let config = TrainConfig {
        density: DensityConfig { depth_seeding: 1000, ..DensityConfig::default() },
        steps: 40,
        ..self::config()
    };
    let mut trainer = Trainer::new(&gpu(), config, &dataset(20).1).unwrap();
    advance(&mut trainer, 20);
    assert_eq!(trainer.gaussian_count(), 64 * 48 / 8);
}

#[test]
fn seeding_stops_at_the_maximum_number_of_gaussians() {
    for (most, expected) in [(150, 150), (50, 50), (1, 1)] {
        let config = TrainConfig { max_gaussians: most, steps: 40, ..config() };
        let mut trainer = Trainer::new(&gpu(), config, &dataset(20).1).unwrap();
        advance(&mut trainer, 20);
        assert_eq!(trainer.gaussian_count(), expected);
    }
}

#[test]
fn seeding_with_every_part_gives_the_same_bits_however_steps_are_submitted_and_interrupted() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = dataset(12).1;
    for parts in [&[][..], &[Part::Structure, Part::Denoiser]] {
        let mut config = TrainConfig { steps: 44, ..config() };
        set_small_parts(&mut config, parts);
        config.model.denoiser_crop = 16;
        config.exposure.learn = parts.is_empty();
        let gpu = gpu();
        let new = || Trainer::new(&gpu, config.clone(), &dataset).unwrap();
        let end = |mut trainer: Trainer| {
            advance(&mut trainer, 44);
            let path = folder.path().join("end.safetensors");
            trainer.save_checkpoint(&path).unwrap();
            fs::read(path).unwrap()
        };
        let expected = end(new());
        let mut one_by_one = new();
        one_by_one.set_batching(1, Some(1));
        assert!(end(one_by_one) == expected, "{parts:?}: one by one");
        for step in [7, 20, 33] {
            let checkpoint = folder.path().join("checkpoint.safetensors");
            let mut interrupted = new();
            advance(&mut interrupted, step);
            interrupted.save_checkpoint(&checkpoint).unwrap();
            let mut restored = new();
            restored.restore(&checkpoint).unwrap();
            assert!(end(restored) == expected, "{parts:?}: from step {step}");
        }
    }
}

#[test]
fn masked_pixels_seed_no_gaussians() {
    let hidden = |color: [f32; 3]| {
        let mut dataset = dataset(20).1;
        for view in &mut dataset.views {
            let (width, height) = (view.camera.width, view.camera.height);
            let is_hidden = |x: u32| x > width / 2;
            let weights = (0..width * height).map(|pixel| f32::from(!is_hidden(pixel % width)));
            view.mask = Some(Mask { width, height, weights: weights.collect() });
            view.image = view.image.as_ref().map(|image| {
                let paint = |x, y| if is_hidden(x) { color } else { image.pixel(x, y) };
                Image::from_fn(width, height, paint)
            });
            view.original = None;
        }
        let tone = ToneSettings::new(ToneCurve::Ap3);
        train(&TrainConfig { steps: 40, tone, ..config() }, &dataset).1
    };
    let [dark, bright] = [hidden([0.0; 3]), hidden([1.0, 0.5, 0.9])];
    assert_eq!(dark.count, 300);
    assert!(dark == bright);
}
