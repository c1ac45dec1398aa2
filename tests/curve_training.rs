//! Training with every kind of curve: evaluated in the loss, baked at upload, of the scene; and from what a run records.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

use nightsplat::dataset::Dataset;
use nightsplat::tone::{Table, ToneCurve, ToneSettings};
use nightsplat::train::TrainConfig;

mod common;

/// The losses of the first steps, and the parameters after them.
fn train(config: &TrainConfig, dataset: &Dataset) -> (Vec<f64>, Vec<f32>) {
    let (reports, gaussians) = common::train::train(config, dataset);
    (reports.into_iter().map(|report| report.loss).collect(), gaussians.parameters)
}

fn config(tone: ToneSettings) -> TrainConfig {
    TrainConfig { steps: 5, sh_degree: 0, tone, ..TrainConfig::default() }
}

/// Points so close that the cubics between them are the curve's to 1e-4.
fn dense_table(curve: ToneCurve) -> Table {
    let settings = ToneSettings::new(curve);
    let plain = settings.plain_statistics();
    let x: Vec<f64> = (0..=2000).map(|i| f64::from(i) / 400.0).collect();
    Table { y: vec![x.iter().map(|&t| settings.value(t, &plain)).collect()], x, ..Table::default() }
}

#[test]
fn every_kind_of_curve_trains_and_a_recorded_configuration_repeats_it() {
    let dataset = common::train::dataset(5, [32, 24]);
    let kinds = [
        ToneSettings::new(ToneCurve::Hybrid),
        ToneSettings { constants: vec![0.9, 0.4], ..ToneSettings::new(ToneCurve::Gamma) },
        ToneSettings::new(ToneCurve::P80),
        ToneSettings::new(ToneCurve::LumPreserve),
        ToneSettings::new(ToneCurve::PerChannel),
        ToneSettings { scene_statistics: true, ..ToneSettings::new(ToneCurve::Ase) },
        ToneSettings::of_table(dense_table(ToneCurve::Rational)),
    ];
    for tone in kinds {
        let config = config(tone);
        let (losses, parameters) = train(&config, &dataset);
        assert!(losses.iter().all(|loss| loss.is_finite() && *loss > 0.0), "{losses:?}");
        let recorded: TrainConfig = toml::from_str(&config.to_toml().unwrap()).unwrap();
        assert_eq!(train(&recorded, &dataset), (losses, parameters), "{}", config.tone.curve);
    }
}

#[test]
fn a_baked_target_trains_as_the_curve_in_the_loss() {
    let dataset = common::train::dataset(5, [32, 24]);
    let in_loss = train(&config(ToneSettings::new(ToneCurve::PowerSoftexp)), &dataset).0;
    let table = ToneSettings::of_table(dense_table(ToneCurve::PowerSoftexp));
    let baked = train(&config(table), &dataset).0;
    for (a, b) in in_loss.iter().zip(&baked) {
        assert!((a - b).abs() < 2e-3, "{in_loss:?} and {baked:?}");
    }
}

#[test]
fn the_statistics_of_the_scene_are_not_those_of_a_view() {
    let dataset = common::train::dataset(5, [32, 24]);
    let settings = ToneSettings::new(ToneCurve::Ap3);
    let scene = ToneSettings { scene_statistics: true, ..settings.clone() };
    assert_ne!(train(&config(settings), &dataset).0, train(&config(scene), &dataset).0);
}
