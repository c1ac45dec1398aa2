//! Runs that store data in fewer bits: exact formats give the same run, the others a close one.

use std::sync::{Mutex, MutexGuard, PoisonError};

use nightsplat::train::{PhotographBits, PrecisionConfig};

use crate::common::prelude::*;

/// The device and the peak of its memory are shared: one test at a time.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

fn config(tone: ToneSettings, photographs: PhotographBits) -> TrainConfig {
    let precision = PrecisionConfig { photographs, ..TrainConfig::bare().precision };
    TrainConfig { steps: 4, sh_degree: 0, tone, precision, ..TrainConfig::bare() }
}

/// The losses of the steps, the resulting parameters, and the peak of the memory.
fn train(config: &TrainConfig, dataset: &Dataset) -> (Vec<f64>, Vec<f32>, u64) {
    static OWN: OnceLock<Gpu> = OnceLock::new();
    let gpu = OWN.get_or_init(crate::common::own_gpu);
    let mut trainer = Trainer::new(gpu, config.clone(), dataset).unwrap();
    gpu.reset_peak_memory();
    let reports = advance(&mut trainer, config.steps);
    let losses = reports.into_iter().map(|report| report.loss).collect();
    (losses, trainer.gaussians().unwrap().parameters, gpu.peak_memory())
}

/// With and without networks, with the curve in the loss and with precomputed targets, whole views and small ones.
#[test]
fn photographs_in_the_fewest_exact_bits_train_to_the_same_bits_in_less_memory() {
    let _alone = alone();
    let dataset = crate::common::train::dataset(4, [96, 72]);
    for (tone, parts, is_smaller) in [
        (ToneSettings::new(ToneCurve::Ap3), false, true),
        (ToneSettings::new(ToneCurve::None), true, true),
        (ToneSettings::default(), false, false),
        (ToneSettings { full_resolution: true, ..ToneSettings::new(ToneCurve::Ase) }, true, true),
    ] {
        let run = |bits| {
            let mut config = config(tone.clone(), bits);
            config.schedule.resolution_steps = Some([0, 2]);
            config.model.denoiser = parts && tone.curve == ToneCurve::Ase;
            config.model.structure = parts;
            train(&config, &dataset)
        };
        let (exact, single) = (run(PhotographBits::Exact), run(PhotographBits::Single));
        assert!(exact.0 == single.0 && exact.1 == single.1, "{} differs", tone.curve);
        assert!(exact.2 < single.2 || !is_smaller, "{}: {} bytes", tone.curve, exact.2);
    }
}

#[test]
fn photographs_in_fewer_bits_train_to_nearly_the_same_losses() {
    let _alone = alone();
    let dataset = crate::common::train::dataset(6, [160, 120]);
    let run = |bits| {
        let mut config = config(ToneSettings::default(), bits);
        // Views of half their size have values between the codes of a file.
        config.schedule.resolution_steps = Some([0, config.steps + 1]);
        train(&config, &dataset)
    };
    let single = run(PhotographBits::Single);
    for (bits, bound) in [(PhotographBits::Sixteen, 1e-4), (PhotographBits::Eight, 1e-2)] {
        let coarse = run(bits);
        assert!(coarse.2 < single.2, "{bits:?}: {} bytes, not below {}", coarse.2, single.2);
        for (loss, exact) in coarse.0.iter().zip(&single.0) {
            assert!((loss / exact - 1.0).abs() < bound, "{bits:?}: {loss}, not {exact}");
        }
        assert_ne!(coarse.1, single.1, "{bits:?}");
    }
}

#[test]
fn a_step_on_coded_photographs_agrees_with_the_references() {
    let _alone = alone();
    let dataset = crate::common::train::dataset(4, [64, 48]);
    let config = config(ToneSettings::new(ToneCurve::Ap3), PhotographBits::Exact);
    let mut trainer = Trainer::new(&gpu(), config, &dataset).unwrap();
    let (reports, checks) = agreeing_step(&mut trainer);
    assert_eq!(reports.len(), 1);
    assert!(checks.passes.iter().any(|pass| pass.kernel == "pseudo_gt"), "nothing was decoded");
}

#[test]
fn the_bits_are_an_ordinary_setting() {
    let with = |assignment: &str| TrainConfig::bare().with(&[assignment.to_owned()]);
    for (text, bits) in [
        ("exact", PhotographBits::Exact),
        ("32", PhotographBits::Single),
        ("16", PhotographBits::Sixteen),
        ("8", PhotographBits::Eight),
    ] {
        let config = with(&format!("precision.photographs={text}")).unwrap();
        assert_eq!(config.precision.photographs, bits);
        assert_eq!(TrainConfig::from_toml(&config.to_toml().unwrap()).unwrap(), config);
    }
    let message = with("precision.photographs=12").unwrap_err().to_string();
    says(&message, &["precision.photographs is", "exact"]);
}
