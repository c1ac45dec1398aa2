//! Trainings on photographs of different exposure.

use nightsplat::kernels::exposure::BIAS_SCALE;
use nightsplat::results::run::{self, IfExists};
use nightsplat::train::Part;
use nightsplat_photographs::dataset::View;
use nightsplat_photographs::exposures::{Affine, table};
use nightsplat_photographs::image::srgb_from_linear;

use crate::common::prelude::*;

/// The factors of the views' light, in groups of four.
const FACTORS: [f32; 4] = [1.0, 0.5, 0.25, 2.0];

/// Synthetic views, each darkened or brightened, under one curve.
fn varied() -> (Folder, TrainConfig, Dataset) {
    let mut tone = ToneSettings::new(ToneCurve::Ase);
    tone.scene_statistics = true;
    let mut config = TrainConfig { steps: 300, sh_degree: 0, tone, ..TrainConfig::bare() };
    config.schedule.densify_before = 0;
    config.schedule.resolution_steps = Some([0, 40]);
    config.exposure.learn = true;
    let folder = written(&small_set(14, [40, 30], 3));
    let mut dataset = Dataset::load(&folder, &config.load_options()).unwrap();
    for (at, view) in dataset.views.iter_mut().filter(|view| view.is_train()).enumerate() {
        let image = view.image.as_mut().unwrap();
        for x in &mut image.data {
            *x = srgb_from_linear(FACTORS[at % 4] * linear_from_srgb(*x));
        }
    }
    (folder, config, dataset)
}

fn l1_of_last_steps(config: &TrainConfig, dataset: &Dataset) -> f64 {
    let mut trainer = Trainer::new(&gpu(), config.clone(), dataset).unwrap();
    let reports = advance(&mut trainer, config.steps);
    let last = &reports[reports.len() - 24..];
    last.iter().map(|report| report.term(nightsplat::loss::Term::L1)).sum::<f64>() / 24.0
}

#[test]
fn exposures_explain_photographs_that_differ_in_brightness_and_their_mean_is_exact_after_every_step()
 {
    let (_folder, config, dataset) = varied();
    let mut trainer = Trainer::new(&gpu(), config.clone(), &dataset).unwrap();
    for step in [1, 2, 3, 50, 300] {
        advance(&mut trainer, step);
        let exposures = trainer.exposures().unwrap().unwrap();
        assert_eq!(exposures.len(), dataset.train_views().count());
        for c in 0..3 {
            // In the quanta of the parameters.
            let sum = |of: fn(&Affine, usize) -> f64| {
                let quanta = |affine: &Affine| (of(affine, c) * 2f64.powi(21)).round();
                exposures.iter().map(|(_, affine)| quanta(affine)).sum::<f64>()
            };
            assert_eq!(sum(|e, c| e.gain[c].ln()), 0.0, "step {step}");
            assert_eq!(sum(|e, c| e.bias[c] / BIAS_SCALE), 0.0, "step {step}");
        }
    }
    let stops = |at: usize| trainer.exposures().unwrap().unwrap()[at].1.stops();
    let (quarter, half, one, two) = (stops(2), stops(1), stops(0), stops(3));
    assert!(quarter < half && half < one && one < two, "{quarter} {half} {one} {two}");
    let with = l1_of_last_steps(&config, &dataset);
    let mut config = config;
    config.exposure.learn = false;
    let without = l1_of_last_steps(&config, &dataset);
    assert!(with < 0.6 * without, "L1 is {with} with exposures and {without} without");
}

#[test]
fn exposures_that_are_off_leave_no_kernel_and_no_file() {
    let (folder, mut config, dataset) = varied();
    config.steps = 2;
    let out = folder.join("run");
    for learn in [true, false] {
        config.exposure.learn = learn;
        let gpu = gpu();
        let mut trainer = Trainer::new(&gpu, config.clone(), &dataset).unwrap();
        let (_, checked) = agreeing_step(&mut trainer);
        let passes = checked.passes.iter().filter(|pass| pass.kernel.starts_with("expos")).count();
        assert_eq!(passes, if learn { 4 } else { 0 });
        run::train(&gpu, &config, &dataset, &out, IfExists::Replace, |_| {}).unwrap();
        let exposures = run::load_exposures(&out).unwrap();
        let metrics = fs::read_to_string(out.join("metrics.json")).unwrap();
        let metrics: Value = serde_json::from_str(&metrics).unwrap();
        if learn {
            let learned = trainer.exposures().unwrap().unwrap();
            assert_eq!(exposures.len(), learned.len());
            assert!(metrics["exposure"].as_str().unwrap().starts_with("neutral"));
            let aligned = metrics["aligned_with_reference"]["mean"]["psnr"].as_f64().unwrap();
            assert!(aligned >= metrics["mean"]["psnr"].as_f64().unwrap() - 0.01);
        } else {
            assert!(exposures.is_empty() && !out.join("exposures.csv").exists());
            assert_eq!(
                (&metrics["exposure"], &metrics["aligned_with_reference"]),
                (&().into(), &().into())
            );
        }
    }
}

#[test]
fn a_run_with_exposures_is_resumed_bit_for_bit() {
    let (folder, mut config, dataset) = varied();
    config.steps = 30;
    let gpu = gpu();
    let new = || Trainer::new(&gpu, config.clone(), &dataset).unwrap();
    let state = |trainer: &mut Trainer, name: &str| {
        let path = folder.join(name);
        trainer.save_checkpoint(&path).unwrap();
        fs::read(path).unwrap()
    };
    let mut whole = new();
    advance(&mut whole, 30);
    let mut interrupted = new();
    advance(&mut interrupted, 17);
    state(&mut interrupted, "checkpoint");
    let mut resumed = new();
    resumed.restore(&folder.join("checkpoint")).unwrap();
    advance(&mut resumed, 30);
    assert!(state(&mut whole, "whole") == state(&mut resumed, "resumed"));
    assert_eq!(whole.exposures().unwrap(), resumed.exposures().unwrap());
    let mut off = config.clone();
    off.exposure.learn = false;
    let mut off = Trainer::new(&gpu, off, &dataset).unwrap();
    let error = off.restore(&folder.join("checkpoint")).unwrap_err().to_string();
    assert!(error.contains("exposure.learn"), "{error}");
}

#[test]
fn a_denoiser_on_crops_sees_the_neutral_exposure_and_a_tonemapper_is_refused() {
    let (_folder, mut config, dataset) = varied();
    set_small_parts(&mut config, &[Part::Denoiser, Part::Structure]);
    config.model.denoiser_crop = 16;
    let gpu = gpu();
    let mut trainer = Trainer::new(&gpu, config.clone(), &dataset).unwrap();
    agreeing_step(&mut trainer);
    config.model.set_parts(&Part::ALL);
    let error = Trainer::new(&gpu, config, &dataset).unwrap_err().to_string();
    says(&error, &["tonemapper", "exposure.learn"]);
}

#[test]
fn without_a_table_exposures_start_at_those_of_the_shared_points() {
    let (folder, mut config, dataset) = varied();
    let begin = |config: &TrainConfig| -> Vec<Affine> {
        let trainer = Trainer::new(&gpu(), config.clone(), &dataset).unwrap();
        trainer.exposures().unwrap().unwrap().into_iter().map(|(_, affine)| affine).collect()
    };
    let found = begin(&config);
    let planted = folder.join("planted.csv");
    let lines = dataset.train_views().zip(FACTORS.iter().cycle());
    let line = |(view, factor): (&View, &f32)| format!("{},{}\n", view.name, factor.log2());
    fs::write(&planted, format!("name,ev\n{}", lines.map(line).collect::<String>())).unwrap();
    config.exposure.start = Some(planted);
    for (found, planted) in found.iter().zip(begin(&config)) {
        let error = found.stops() - planted.stops();
        assert!(error.abs() < 0.1, "{error} stops: {found} is not {planted}");
    }
    assert!(found[3].stops() - found[2].stops() > 0.5, "{} {}", found[3], found[2]);
}

/// The brightness of a held-out view says nothing about the model.
#[test]
fn a_held_out_view_scores_alike_at_any_exposure() {
    let (_folder, mut config, mut dataset) = varied();
    let held_out = dataset.views.iter().position(View::is_train).unwrap();
    dataset.views[held_out].split = Split::HeldOut;
    let mut scores = vec![];
    for gain in [1.0, 0.5] {
        for x in &mut dataset.views[held_out].image.as_mut().unwrap().data {
            *x *= gain;
        }
        config.tone = ToneSettings::new(ToneCurve::None);
        let mut trainer = Trainer::new(&gpu(), config.clone(), &dataset).unwrap();
        advance(&mut trainer, 20);
        scores.push(trainer.held_out_psnr().unwrap().unwrap());
    }
    // Against a target of half the contrast, an error is half as large: 6.02 dB.
    let gap = scores[1] - scores[0];
    assert!((gap - 6.02).abs() < 0.3, "{scores:?}");
}

#[test]
fn a_table_sets_the_initial_exposures() {
    let (folder, mut config, dataset) = varied();
    let names: Vec<&str> = dataset.train_views().map(|view| view.name.as_str()).collect();
    let path = folder.join("known.csv");
    let begin = |config: &TrainConfig| {
        let trainer = Trainer::new(&gpu(), config.clone(), &dataset).unwrap();
        let exposures = trainer.exposures().unwrap().unwrap();
        exposures.into_iter().map(|(_, exposure)| exposure).collect::<Vec<Affine>>()
    };
    // Stops of the photographs: with one curve, the targets differ accordingly.
    let lines = names.iter().zip(FACTORS.iter().cycle());
    let lines: String = lines.map(|(name, factor)| format!("{name},{}\n", factor.log2())).collect();
    fs::write(&path, format!("name,ev\n{lines}")).unwrap();
    config.exposure.start = Some(path.clone());
    let of_stops = begin(&config);
    assert!(of_stops[2].stops() < of_stops[1].stops() && of_stops[1].stops() < of_stops[0].stops());
    // Next to the photographs, it is found.
    fs::copy(&path, folder.join("exposures.csv")).unwrap();
    config.exposure.start = None;
    assert_eq!(begin(&config), of_stops);

    // The exposures of a finished run are initial values.
    let exposures: Vec<(String, Affine)> =
        names.iter().map(|&name| name.to_owned()).zip(of_stops.iter().copied()).collect();
    table::save(&path, &exposures).unwrap();
    config.exposure.start = Some(path.clone());
    for (again, first) in begin(&config).iter().zip(&of_stops) {
        let gap = |c: usize| {
            (again.gain[c] - first.gain[c]).abs() + (again.bias[c] - first.bias[c]).abs()
        };
        assert!((0..3).all(|c| gap(c) < 4e-6), "{again} is not {first}");
    }

    fs::write(&path, "name,ev\nnoone,1\nelsewhere,2\n").unwrap();
    let error = Trainer::new(&gpu(), config, &dataset).unwrap_err().to_string();
    says(&error, &["noone, elsewhere", "known.csv"]);
}
