//! Training with every kind of curve: evaluated in the loss, baked at upload, fitted to the scene; and from a run's
//! recorded configuration.

use nightsplat_photographs::dataset::LoadOptions;
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{MeasuredPhotograph, Table, Tone};

use crate::common::prelude::*;

/// The losses of the first steps and the resulting parameters.
fn train(config: &TrainConfig, dataset: &Dataset) -> (Vec<f64>, Vec<f32>) {
    let (reports, gaussians) = crate::common::train::train(config, dataset);
    (reports.into_iter().map(|report| report.loss).collect(), gaussians.parameters)
}

fn config(tone: ToneSettings) -> TrainConfig {
    TrainConfig { steps: 5, sh_degree: 0, tone, ..TrainConfig::bare() }
}

/// Knots so close that the cubics between them agree with the curve to 1e-4.
fn dense_table(curve: ToneCurve) -> Table {
    let settings = ToneSettings::new(curve);
    let plain = settings.plain_statistics();
    let x: Vec<f64> = (0..=2000).map(|i| f64::from(i) / 400.0).collect();
    Table { y: vec![x.iter().map(|&t| settings.value(t, &plain)).collect()], x, ..Table::default() }
}

#[test]
fn every_kind_of_curve_trains_and_a_recorded_configuration_repeats_it() {
    let dataset = crate::common::train::dataset(5, [32, 24]);
    let kinds = [
        ToneSettings::new(ToneCurve::Hybrid),
        ToneSettings { constants: vec![0.9, 0.4], ..ToneSettings::new(ToneCurve::Gamma) },
        ToneSettings::new(ToneCurve::P80),
        ToneSettings::new(ToneCurve::LumPreserve),
        ToneSettings::new(ToneCurve::PerChannel),
        ToneSettings { scene_statistics: true, ..ToneSettings::new(ToneCurve::Ase) },
        ToneSettings::default(),
        ToneSettings { colour: 0.0, brightness: Some(0.4), ..ToneSettings::default() },
        ToneSettings::new(ToneCurve::Ap3).with_gain(None),
        ToneSettings { full_resolution: true, ..ToneSettings::new(ToneCurve::Ap3) },
        ToneSettings::new(Tone::Table(dense_table(ToneCurve::Rational))),
        ToneSettings::new(Tone::Profile(crate::common::setup::profile())),
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
    let dataset = crate::common::train::dataset(5, [32, 24]);
    let in_loss = train(&config(ToneSettings::new(ToneCurve::PowerSoftexp)), &dataset).0;
    let table = ToneSettings::new(Tone::Table(dense_table(ToneCurve::PowerSoftexp)));
    let baked = train(&config(table), &dataset).0;
    for (a, b) in in_loss.iter().zip(&baked) {
        assert!((a - b).abs() < 2e-3, "{in_loss:?} and {baked:?}");
    }
}

#[test]
fn the_statistics_of_the_scene_are_measured_over_all_views() {
    let dataset = crate::common::train::dataset(5, [32, 24]);
    let settings = ToneSettings::new(ToneCurve::Ap3);
    let scene = ToneSettings { scene_statistics: true, ..settings.clone() };
    assert_ne!(train(&config(settings), &dataset).0, train(&config(scene), &dataset).0);
}

/// What training measures in a dataset whose training photographs are scaled, one by one.
fn scene(dataset: &Dataset, factors: impl Fn(usize) -> f32) -> nightsplat::Result<SceneTone> {
    let mut dataset = dataset.clone();
    let training = dataset.views.iter_mut().filter(|view| view.is_train());
    for (index, image) in training.filter_map(|view| view.image.as_mut()).enumerate() {
        image.data.iter_mut().for_each(|x| *x = (*x * factors(index)).min(1.0));
    }
    let trainer = Trainer::new(&gpu(), config(ToneSettings::default()), &dataset)?;
    Ok(trainer.scene().clone())
}

#[test]
fn darker_views_get_more_gain_and_the_model_the_mean_of_them() {
    let dataset = crate::common::train::dataset(6, [32, 24]);
    let uniform = scene(&dataset, |_| 1.0).unwrap().gains(&dataset);
    assert_eq!(uniform.len(), 5);
    let varied = scene(&dataset, |index| [1.0, 0.5, 0.25, 2.0, 1.0][index]).unwrap();
    let gains = varied.gains(&dataset);
    for ((name, gain), factor) in gains.iter().zip([1.0, 0.5, 0.25, 2.0, 1.0]) {
        // The scene's gain follows its brightest views, to which each view contributes.
        let ratio = gain * factor / uniform[name];
        assert!((0.75..1.35).contains(&ratio), "{name}: {gain}, {}", uniform[name]);
    }
    let product: f64 = gains.values().product();
    assert!((varied.model_gain.unwrap() / product.powf(0.2) - 1.0).abs() < 1e-9);
    let shared = ToneSettings { scene_statistics: true, ..ToneSettings::default() };
    let trainer = Trainer::new(&gpu(), config(shared), &dataset).unwrap();
    let exposure = trainer.scene().exposure.as_ref().unwrap();
    assert!(trainer.scene().gains(&dataset).values().all(|&gain| gain == exposure.gain));
}

#[test]
fn unusual_datasets_have_a_defined_brightness_or_a_clear_error() {
    let dataset = crate::common::train::dataset(6, [32, 24]);
    let mut single = dataset.clone();
    let first = single.views.iter().position(|view| view.is_train()).unwrap();
    single.views.retain({
        let name = single.views[first].name.clone();
        move |view| view.name == name
    });
    let exposure = |scene: &SceneTone| scene.exposure.clone().unwrap();
    let one = scene(&single, |_| 1.0).unwrap();
    let (model_gain, one) = (one.model_gain.unwrap(), exposure(&one));
    assert!((model_gain / one.gain - 1.0).abs() < 1e-9 && one.spread == 0.0);
    // Black views among usable ones are left out of the measurement and use the scene's gain.
    let with_black = scene(&dataset, |index| if index < 2 { 0.0 } else { 1.0 }).unwrap();
    assert_eq!(exposure(&with_black).black, 2);
    let gains = with_black.gains(&dataset);
    assert_eq!(gains.values().next(), Some(&exposure(&with_black).gain));
    let error = scene(&dataset, |_| 0.0).unwrap_err().to_string();
    assert!(error.contains("almost black") && !error.contains('\n'), "{error}");
    // Half of them well lit, then all.
    let half = exposure(&scene(&dataset, |index| if index % 2 == 0 { 8.0 } else { 1.0 }).unwrap());
    assert!(half.share > 0.9, "{half:?}");
    let well_lit = exposure(&scene(&dataset, |_| 9.0).unwrap());
    assert_eq!(well_lit.weight(), 0.0, "{}", well_lit.reason());
}

/// Targets are area means of tone-mapped photographs, not tone-mapped means.
#[test]
fn photographs_are_tone_mapped_before_they_are_downscaled() {
    let options = small_set(5, [96, 72], 1);
    let folder = written(&options);
    let load = |folder: &Folder| {
        let options = LoadOptions { downscale: 3.0, ..LoadOptions::default() };
        Dataset::load(folder, &options).unwrap()
    };
    let shrunk = load(&folder);
    let view = &shrunk.views[1];
    let original = view.photograph().unwrap().unwrap();
    assert_eq!([original.width, original.height], [96, 72]);
    assert_eq!(view.image.as_ref(), Some(&original.resized(32, 24)));

    let settings = ToneSettings::default();
    let expected = train(&config(settings.clone()), &shrunk).0;
    let pseudo_gt = PseudoGt::new(&gpu(), &settings).unwrap();
    let photographs = shrunk
        .train_views()
        .map(|view| (view.name.clone(), view.photograph().unwrap().unwrap().into_owned()));
    let photographs: Vec<(String, Image)> = photographs.collect();
    let seen = photographs.iter().zip(shrunk.train_views());
    let measured: Vec<_> = seen
        .map(|((_, image), view)| MeasuredPhotograph::measure(&image.data).seen_by(&view.camera))
        .collect();
    let scene = SceneTone::from_photographs(&settings, &measured).unwrap();
    for ((name, photograph), measured) in photographs.iter().zip(&measured) {
        let tone_mapped = pseudo_gt.tone_mapped(photograph, &scene.curve_of(measured)).unwrap();
        tone_mapped.save_png16(folder.join("low").join(format!("{name}.png"))).unwrap();
    }
    let elsewhere = train(&config(ToneSettings::new(ToneCurve::None)), &load(&folder)).0;
    for (a, b) in expected.iter().zip(&elsewhere) {
        assert!((a - b).abs() < 1e-4, "{expected:?} and {elsewhere:?}");
    }
    let dark = load(&written(&options));
    let late = train(&config(ToneSettings { full_resolution: false, ..settings }), &dark).0;
    assert_ne!(expected, late);
}
