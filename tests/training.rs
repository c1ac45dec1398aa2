//! Training end to end on a small synthetic set.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use nightsplat::Error;
use nightsplat::attributes::Attribute;
use nightsplat::dataset::{Dataset, Split};
use nightsplat::eval::{self, Player};
use nightsplat::gpu::testing::gpu;
use nightsplat::image::Image;
use nightsplat::metrics::Scores;
use nightsplat::scene::Gaussians;
use nightsplat::train::{Background, StepReport, TrainConfig, Trainer};

mod common;
use common::train::{advance, train};

/// Ten views of 64 x 48 pixels.
fn dataset() -> Dataset {
    common::train::dataset(10, [64, 48])
}

/// Density control acts twice within sixty steps.
fn config() -> TrainConfig {
    let mut config = TrainConfig { steps: 60, ..Default::default() };
    config.schedule.densify_after = 10;
    config.schedule.densify_interval = 20;
    config.schedule.sh_degree_interval = 15;
    config
}

fn mean_psnr(dataset: &Dataset, gaussians: &Gaussians) -> f64 {
    let mut player = Player::new(&gpu(), gaussians, false, None, None).unwrap();
    let scored = eval::score(dataset, |view| player.render(view)).unwrap();
    let scores: Vec<Scores> = scored.iter().map(|view| view.scores).collect();
    Scores::mean(&scores).unwrap().psnr
}

#[test]
fn a_model_learns_to_show_the_scene_by_normal_light() {
    let dataset = dataset();
    let config = TrainConfig { steps: 200, ..config() };
    let (reports, gaussians) = train(&config, &dataset);
    let steps: Vec<u64> = reports.iter().map(|report| report.step).collect();
    assert_eq!(steps, (1..=200).collect::<Vec<_>>());
    let mean = |reports: &[StepReport]| {
        reports.iter().map(|report| report.loss).sum::<f64>() / reports.len() as f64
    };
    let (begin, end) = (mean(&reports[..9]), mean(&reports[191..]));
    assert!(end < 0.6 * begin, "the loss went from {begin} to {end}");
    let dark: Vec<Scores> = dataset
        .test_views()
        .map(|view| {
            Scores::of(view.image.as_ref().unwrap(), view.reference.as_ref().unwrap()).unwrap()
        })
        .collect();
    let (dark, lit) = (Scores::mean(&dark).unwrap().psnr, mean_psnr(&dataset, &gaussians));
    assert!(lit > dark + 8.0, "the photographs score {dark} dB, the renders {lit} dB");
}

#[test]
fn the_same_seed_gives_the_same_bits_and_another_seed_others() {
    let dataset = dataset();
    let config = TrainConfig { background: Background::Random, ..config() };
    let (_, first) = train(&config, &dataset);
    let (_, second) = train(&config, &dataset);
    assert_eq!(first, second);
    let (_, other) = train(&TrainConfig { seed: 11, ..config }, &dataset);
    assert_ne!(first.parameters, other.parameters);
}

#[test]
fn references_change_no_trained_bit() {
    let dataset = dataset();
    let mut spoiled = dataset.clone();
    for view in &mut spoiled.views {
        view.reference =
            Some(Image::filled(view.camera.width, view.camera.height, [0.9, 0.1, 0.5]));
        if view.split == Split::Test {
            view.image = None;
        }
    }
    assert_eq!(train(&config(), &dataset).1, train(&config(), &spoiled).1);
}

#[test]
fn steps_that_outgrow_their_memory_are_redone_and_nothing_is_lost() {
    let dataset = dataset();
    let config = TrainConfig { steps: 20, ..config() };
    let run = |reserved: u32| {
        let mut trainer = Trainer::new(&gpu(), config.clone(), &dataset).unwrap();
        trainer.set_intersection_capacity(reserved).unwrap();
        let mut reports = vec![];
        let mut submissions = 0;
        while trainer.steps_done() < config.steps {
            reports.extend(trainer.advance(config.steps).unwrap());
            submissions += 1;
        }
        let steps: Vec<u64> = reports.iter().map(|report| report.step).collect();
        assert_eq!(steps, (1..=20).collect::<Vec<_>>());
        (submissions, trainer.gaussians().unwrap())
    };
    let (few, roomy) = run(100_000);
    let (more, tight) = run(16);
    assert!(more > few, "{more} submissions, {few} without an overflow");
    assert_eq!(roomy, tight);
}

#[test]
fn a_loss_that_is_not_finite_names_step_view_and_term() {
    let dataset = dataset();
    let mut config = config();
    // The colours of the second step are finite, their squares in SSIM are not.
    config.schedule.initial_rates[Attribute::Dc] = 1e30;
    let mut trainer = Trainer::new(&gpu(), config, &dataset).unwrap();
    let error = trainer.advance(20).unwrap_err();
    let Error::NotFinite { step, view, what } = &error else { panic!("{error}") };
    assert_eq!((*step, what.as_str()), (2, "SSIM"));
    assert!(dataset.train_views().any(|train| train.name == *view), "{error}");
    assert_eq!(trainer.steps_done(), 1);
    assert!(trainer.gaussians().unwrap().parameters.iter().all(|value| value.is_finite()));
}

#[test]
fn a_set_without_points_begins_with_random_ones() {
    let mut dataset = dataset();
    dataset.points.clear();
    let config = TrainConfig { steps: 10, random_points: 300, ..config() };
    let (reports, gaussians) = train(&config, &dataset);
    assert_eq!((reports.len(), gaussians.count), (10, 300));
    assert!(gaussians.parameters.iter().all(|value| value.is_finite()));
}

#[test]
fn growth_stops_at_the_limit() {
    let dataset = dataset();
    let limit = dataset.points.len() + 5;
    let mut config = TrainConfig { max_gaussians: limit, ..config() };
    config.density.gradient_threshold = 1e-9;
    let (_, gaussians) = train(&config, &dataset);
    assert_eq!(gaussians.count, limit);
}

#[test]
fn a_render_shows_what_its_model_was_trained_to() {
    let dataset = dataset();
    let mut trainer = Trainer::new(&gpu(), config(), &dataset).unwrap();
    advance(&mut trainer, 60);
    let view = &dataset.views[0];
    let in_training = trainer.render(&view.camera).unwrap();
    let mut player = Player::new(&gpu(), &trainer.gaussians().unwrap(), false, None, None).unwrap();
    assert_eq!(in_training.colors.data, player.render(view).unwrap().colors.data);
}
