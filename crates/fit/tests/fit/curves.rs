//! Fits of tone curves: constants are recovered from synthetic pairs, fits to real pairs are better than the published
//! constants, and bad input is named.

use nightsplat_core::Error;
use nightsplat_core::random::Stream;
use nightsplat_fit::{
    Channels, CurveFit, FitOptions, FitScene, Pair, Weighting, cross_validate, fit, psnr,
};
use nightsplat_photographs::image::Image;
use nightsplat_photographs::tone::{FAMILIES, Family, Statistics, ToneCurve, ToneSettings};

use crate::common::shared;
use crate::pairs::{dark, reference, truth};

fn pair(settings: &ToneSettings, dark: &Image, noise: f64, seed: u64) -> Pair {
    Pair::new(format!("{seed}.png"), dark, &reference(settings, dark, noise, seed)).unwrap()
}

fn fit_to(family: &'static Family, pairs: &[Pair], options: &FitOptions) -> CurveFit {
    fit(&family.curve.into(), &pairs.iter().collect::<Vec<_>>(), options).unwrap()
}

fn fitted_on_t() -> impl Iterator<Item = &'static Family> {
    FAMILIES
        .iter()
        .filter(|family| family.is_of_t && !family.constants.is_empty() && family.gain_c == 0.0)
}

const PLAIN: FitOptions = FitOptions {
    channels: Channels::Rgb,
    weighting: Weighting::Pixels,
    prior: 0.0,
    huber: f64::INFINITY,
    bins: 512,
    bounded: false,
    adapt: false,
};

/// Noise of 0.02 on 393 216 values. A constant may be off by 5 of its standard errors and 1 % (clipped noise at white
/// and the finite width of columns shift it a little); the curve itself by 0.005, whether the constants are
/// identifiable or not.
#[test]
fn the_constants_of_every_identifiable_family_are_recovered_from_noisy_pairs() {
    let darks = [dark(256, 0.04, 0.0, 1), dark(256, 0.07, 0.0, 2)];
    for family in fitted_on_t() {
        let truth = truth(family);
        let pairs: Vec<Pair> =
            darks.iter().zip(7..).map(|(dark, seed)| pair(&truth, dark, 0.02, seed)).collect();
        for options in [PLAIN, FitOptions::default()] {
            let found = fit_to(family, &pairs, &options);
            let name = family.name;
            let mut told = format!("{name}:");
            for (constant, truth) in found.constants.iter().zip(&truth.constants) {
                let error = (constant.value - truth).abs();
                told += &format!(" {} {truth:.4} {:+.4}", constant.name, constant.value - truth);
                told += &format!(" ({:.4})", constant.standard_error.unwrap_or(f64::NAN));
                if family.identifiable {
                    let allowed = 5.0 * constant.standard_error.unwrap_or(0.0) + 0.01 * truth.abs();
                    assert!(error <= allowed, "{told}: more than {allowed}");
                }
            }
            println!("{told}");
            for i in 0..=60 {
                let t = 0.05 * f64::from(i);
                let value = |constants: &[f64]| family.curve.value(t, 0.0, 1.0, constants);
                let error = (value(&found.settings.constants) - value(&truth.constants)).abs();
                assert!(error < 0.005, "{name}({t}) is off by {error}");
            }
            assert!(found.rises, "{name}");
            assert!((found.rmse - 0.02).abs() < 0.002, "{name}: {}", found.rmse);
        }
    }
}

/// Twelve photographs of different brightness and black level; each value within 5 standard errors and 3 %.
#[test]
fn black_level_gain_and_target_mean_are_recovered_for_adaptive_curves() {
    let darks: Vec<Image> = (0..12)
        .map(|i| {
            dark(
                64,
                0.02 + 0.015 * f64::from(i),
                0.004 * f64::from(i * 5 % 12),
                100 + u64::from(i as u8),
            )
        })
        .collect();
    for family in FAMILIES.iter().filter(|family| family.curve != ToneCurve::None) {
        let adapts = !family.is_of_t || family.gain_c > 0.0 || family.alpha > 0.0;
        if !adapts {
            continue;
        }
        let mut truth = ToneSettings { theta: 0.42, ..ToneSettings::new(family.curve) };
        if family.is_of_t {
            (truth.alpha, truth.gain_c) = (0.1, 1.7);
            if family.is_rescaled {
                truth.base_gain = 0.9;
            }
        }
        let pairs: Vec<Pair> =
            darks.iter().zip(1..).map(|(dark, seed)| pair(&truth, dark, 0.02, seed)).collect();
        let found = fit_to(family, &pairs, &PLAIN);
        let expected = |name: &str| match name {
            "theta" => truth.theta,
            "alpha" => truth.alpha,
            "gain_c" => truth.gain_c,
            "base_gain" => truth.base_gain,
            _ => truth.constants[0],
        };
        println!("{}: {:?}", family.name, found.constants);
        for constant in &found.constants {
            let truth = expected(&constant.name);
            let allowed = 5.0 * constant.standard_error.unwrap_or(0.0) + 0.03 * truth;
            let error = (constant.value - truth).abs();
            assert!(
                error <= allowed,
                "{} of {}: {} not {truth}",
                constant.name,
                family.name,
                constant.value
            );
        }
    }
    // AP3 with a free cubic: black level and gain of the photograph, constants of the family.
    let family = ToneCurve::Poly3Origin.family();
    let mut truth = truth(family);
    (truth.alpha, truth.gain_c) = (0.12, 1.0);
    let pairs: Vec<Pair> =
        darks.iter().zip(1..).map(|(dark, seed)| pair(&truth, dark, 0.02, seed)).collect();
    let found = fit_to(family, &pairs, &FitOptions { adapt: true, ..PLAIN });
    let dark = &darks[3];
    let of = |settings: &ToneSettings| reference(settings, dark, 0.0, 0).data;
    let worst =
        of(&truth).iter().zip(of(&found.settings)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst < 0.02, "{worst}");
}

#[test]
fn robust_weights_withstand_pixels_that_do_not_match() {
    let family = ToneCurve::Reinhard.family();
    let truth = truth(family);
    let dark = dark(256, 0.05, 0.0, 4);
    let mut moved = reference(&truth, &dark, 0.02, 5);
    let stream = Stream::new(6, 3);
    for (index, value) in (0..).zip(&mut moved.data) {
        if stream.uniform(index) < 0.08 {
            *value = 0.95;
        }
    }
    let pairs = [Pair::new("moved", &dark, &moved).unwrap()];
    let worst = |found: &CurveFit| {
        let error = |i: i32| {
            let value =
                |constants: &[f64]| family.curve.value(0.05 * f64::from(i), 0.0, 1.0, constants);
            (value(&found.settings.constants) - value(&truth.constants)).abs()
        };
        (0..60).map(error).fold(0.0, f64::max)
    };
    let robust = worst(&fit_to(family, &pairs, &FitOptions::default()));
    let plain = worst(&fit_to(family, &pairs, &PLAIN));
    assert!(robust < 0.012 && plain > 3.0 * robust, "{robust} {plain}");
}

/// In 24 fits to different noise, the errors in units of the standard errors must have a root mean square near 1.
#[test]
fn standard_errors_are_as_large_as_the_errors() {
    let family = ToneCurve::PowerSoftexp.family();
    let truth = truth(family);
    let dark = dark(48, 0.05, 0.0, 9);
    for options in [PLAIN, FitOptions::default()] {
        let mut squares = vec![];
        for seed in 0..24 {
            let found = fit_to(family, &[pair(&truth, &dark, 0.02, 1000 + seed)], &options);
            assert_eq!(found.effective_values, found.values);
            for (constant, truth) in found.constants.iter().zip(&truth.constants) {
                squares.push(((constant.value - truth) / constant.standard_error.unwrap()).powi(2));
            }
        }
        let rms = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
        assert!((0.6..1.6).contains(&rms), "{rms}");
    }
}

/// One of five photographs has another exposure: with its own weight, it hardly matters.
#[test]
fn a_photograph_far_from_the_curve_has_little_weight() {
    let family = ToneCurve::Reinhard.family();
    let settings = truth(family);
    let mut pairs: Vec<Pair> =
        (0..4).map(|seed| pair(&settings, &dark(64, 0.05, 0.0, seed), 0.02, seed)).collect();
    let other = ToneSettings { constants: vec![0.6, 0.6], ..settings.clone() };
    pairs.push(pair(&other, &dark(64, 0.05, 0.0, 9), 0.02, 9));
    let error = |weighting| {
        let options = FitOptions { weighting, ..PLAIN };
        let found = fit_to(family, &pairs, &options).settings.constants;
        let value = |constants: &[f64]| family.curve.value(1.0, 0.0, 1.0, constants);
        (value(&found) - value(&settings.constants)).abs()
    };
    let [pixels, photographs] = [Weighting::Pixels, Weighting::Photographs].map(error);
    assert!(photographs < 0.1 * pixels && pixels > 0.02, "{photographs} {pixels}");
}

/// With as much weight as the pairs, the family's own curve moves a linear fit half the way.
#[test]
fn a_prior_counts_as_photographs() {
    let family = ToneCurve::SqrtBlend.family();
    let truth = truth(family);
    let pairs = [
        pair(&truth, &dark(128, 0.02, 0.0, 1), 0.0, 1),
        pair(&truth, &dark(128, 0.02, 0.0, 2), 0.0, 2),
    ];
    let found = fit_to(family, &pairs, &FitOptions { prior: 2.0, ..PLAIN });
    for (constant, truth) in found.constants.iter().zip(&truth.constants) {
        let half = 0.5 * (truth + truth / 0.94);
        assert!((constant.value - half).abs() < 0.02 * half, "{constant:?}, not {half}");
    }
}

#[test]
fn photographs_that_disagree_count_as_fewer_values() {
    let family = ToneCurve::Gamma.family();
    let shifted = |shift: f64, seed: u64| {
        let dark = dark(64, 0.05, 0.0, seed);
        let mut reference = reference(&truth(family), &dark, 0.02, seed);
        reference.data.iter_mut().for_each(|y| *y = (*y + shift as f32).clamp(0.0, 1.0));
        Pair::new("a", &dark, &reference).unwrap()
    };
    let agreeing: Vec<Pair> = (0..6).map(|i| shifted(0.0, i)).collect();
    let disagreeing: Vec<Pair> = (0..6).map(|i| shifted(0.04 * i as f64, i)).collect();
    let [agreeing, disagreeing] =
        [agreeing, disagreeing].map(|pairs| fit_to(family, &pairs, &PLAIN));
    assert!(agreeing.effective_values > 0.1 * agreeing.values);
    assert!(disagreeing.effective_values < 20.0, "{}", disagreeing.effective_values);
    let error = |fit: &CurveFit| fit.constants[0].standard_error.unwrap();
    assert!(error(&disagreeing) > 10.0 * error(&agreeing));
}

/// The reference falls above t = 1.2, as a polynomial could; a curve must not.
#[test]
fn a_fit_rises_and_stays_below_white_if_required() {
    let dark = dark(128, 0.05, 0.0, 3);
    let p90 = Statistics::new(&dark.data).p90;
    let hump = dark.data.iter().map(|x| {
        let t = x / p90;
        (1.3 * t * (2.0 - t)).clamp(0.2, 1.0)
    });
    let reference = Image { data: hump.collect(), ..dark };
    let pairs = [Pair::new("hump", &dark, &reference).unwrap()];
    for curve in [
        ToneCurve::FittedCubic,
        ToneCurve::Poly3Origin,
        ToneCurve::Poly5Origin,
        ToneCurve::Bezier3Standard,
    ] {
        let found = fit_to(curve.family(), &pairs, &FitOptions { bounded: true, ..PLAIN });
        assert!(found.rises && found.bounded, "{curve}: {:?}", found.constants);
        let shape = |t: f64| curve.family().shape(t, &found.settings.constants);
        for i in 0..400 {
            let t = 0.01 * f64::from(i);
            assert!(shape(t) <= shape(t + 0.01) + 1e-4 && shape(t) <= 1.0 + 1e-4, "{curve}({t})");
        }
    }
}

#[test]
fn neither_the_columns_of_the_histogram_nor_the_order_of_the_pairs_matter() {
    let family = ToneCurve::SoftexpGamma.family();
    let truth = truth(family);
    let mut pairs: Vec<Pair> =
        (0..3).map(|seed| pair(&truth, &dark(96, 0.05, 0.0, seed), 0.02, seed)).collect();
    let coarse = fit_to(family, &pairs, &FitOptions { bins: 128, ..PLAIN });
    let fine = fit_to(family, &pairs, &FitOptions { bins: 8192, ..PLAIN });
    for (a, b) in coarse.constants.iter().zip(&fine.constants) {
        assert!((a.value - b.value).abs() < 0.002 * b.value, "{a:?} {b:?}");
    }
    let again = fit_to(family, &pairs, &FitOptions { bins: 8192, ..PLAIN });
    assert_eq!(fine, again);
    pairs.reverse();
    let reversed = fit_to(family, &pairs, &FitOptions { bins: 8192, ..PLAIN });
    assert!((fine.constants[0].value - reversed.constants[0].value).abs() < 1e-6);
    // For grey photographs, the luminance gives the same fit.
    let grey = |image: &Image| Image { data: image.data[..96 * 96].repeat(3), ..*image };
    let greys = [0, 1].map(|seed| {
        let dark = grey(&dark(96, 0.05, 0.0, seed));
        Pair::new("grey", &dark, &grey(&reference(&truth, &dark, 0.02, seed))).unwrap()
    });
    let rgb = fit_to(family, &greys, &PLAIN);
    let luminance = fit_to(family, &greys, &FitOptions { channels: Channels::Luminance, ..PLAIN });
    assert!((rgb.constants[0].value - luminance.constants[0].value).abs() < 0.002);
    assert_eq!(rgb.values, 3.0 * luminance.values);
}

#[test]
fn scores_are_the_psnr_of_the_mapped_photograph() {
    let dark = dark(60, 0.05, 0.01, 2);
    let settings = ToneSettings::new(ToneCurve::Ase);
    let reference = reference(&settings, &dark, 0.05, 8);
    let clamped =
        Image { data: reference.data.iter().map(|y| y.clamp(0.0, 1.0)).collect(), ..reference };
    let pair = Pair::new("a", &dark, &clamped).unwrap();
    for family in FAMILIES
        .iter()
        .filter(|family| !matches!(family.curve, ToneCurve::LumPreserve | ToneCurve::PerChannel))
    {
        let settings = ToneSettings::new(family.curve);
        let parameters = settings.parameters(&pair.statistics);
        let mapped = Image {
            data: dark.data.iter().map(|&x| family.curve.apply(x, &parameters)).collect(),
            ..dark
        };
        let expected = nightsplat_photographs::metrics::psnr(&mapped, &clamped).unwrap();
        let found = psnr(&settings, &pair);
        assert!((found - expected).abs() < 0.01, "{}: {found} dB, not {expected}", family.name);
    }
}

#[test]
fn degenerate_pairs_have_a_defined_result() {
    let flat = |value: f32| Image::filled(16, 16, [value; 3]);
    let one = Pair::new("flat.png", &flat(0.05), &flat(0.5)).unwrap();
    // A single value of t: enough for one constant, not for two.
    let softexp = fit_to(ToneCurve::Softexp.family(), std::slice::from_ref(&one), &PLAIN);
    assert!(
        (ToneCurve::Softexp.value(1.0, 0.0, 1.0, &softexp.settings.constants) - 0.5).abs() < 0.003
    );
    assert_eq!(softexp.r_squared, None);
    let error = fit(&ToneCurve::Gamma.into(), &[&one], &PLAIN).unwrap_err();
    assert!(
        matches!(error, Error::Input { .. }) && error.to_string().contains("1 different values"),
        "{error}"
    );
    // A flat reference: the flattest curve, at a bound if there is one.
    let flat_reference = Pair::new("a.png", &dark(16, 0.05, 0.0, 1), &flat(0.5)).unwrap();
    for family in fitted_on_t() {
        let found = fit_to(family, std::slice::from_ref(&flat_reference), &FitOptions::default());
        assert_eq!(found.r_squared, None, "{}", family.name);
        assert!(found.rmse.is_finite() && found.settings.check().is_ok(), "{}", family.name);
    }
    // One bright pixel in the dark: t is a million.
    let mut lamp = flat(0.0);
    lamp.data[5] = 1.0;
    assert!(Pair::new("lamp.png", &lamp, &flat(0.5)).unwrap().is_black());

    assert!(Pair::new("a.png", &flat(0.1), &Image::filled(8, 16, [0.5; 3])).is_err());
    assert!(
        Pair::new("a.png", &Image::filled(0, 0, [0.0; 3]), &Image::filled(0, 0, [0.0; 3])).is_err()
    );
    for options in [
        FitOptions { huber: 0.0, ..PLAIN },
        FitOptions { huber: f64::NAN, ..PLAIN },
        FitOptions { prior: -1.0, ..PLAIN },
        FitOptions { bins: 7, ..PLAIN },
        FitOptions { bins: 70_000, ..PLAIN },
    ] {
        let error = fit(&ToneCurve::Softexp.into(), &[&one], &options).unwrap_err();
        assert_eq!(error.exit_code(), 2, "{error}");
    }
    assert!(fit(&ToneCurve::None.into(), &[&one], &PLAIN).is_err());
    assert!(fit(&ToneCurve::Softexp.into(), &[], &PLAIN).is_err());
    let scene = FitScene { name: "one".to_owned(), pairs: vec![one] };
    assert!(cross_validate(&ToneCurve::Softexp.into(), &[scene], 5, &PLAIN).is_err());
}

/// AP3's formula with black level, gain and cubic free, and a prior on the published cubic with the weight of the
/// photographs: on every held-out pair, its squared error is lower than AP3's and the cubic's.
fn assert_beats_the_published_constants(scene: FitScene) {
    let (count, scene) = (scene.pairs.len(), [scene]);
    let options = FitOptions { adapt: true, prior: count as f64, ..FitOptions::default() };
    let held_out = cross_validate(&ToneCurve::FittedCubic.into(), &scene, count, &options).unwrap();
    assert_eq!(held_out.folds.len(), count);
    let errors = held_out.squared_error;
    assert!(
        errors.fitted < 0.97 * errors.ap3 && errors.fitted < 0.97 * errors.frozen,
        "{errors:?}"
    );
}

#[test]
fn constants_fitted_to_some_pairs_are_better_than_the_published_ones_on_others() {
    let settings =
        ToneSettings { alpha: 0.1, gain_c: 2.0, ..truth(ToneCurve::FittedCubic.family()) };
    let pairs = (0..6).map(|seed| {
        let dark = dark(48, 0.03 + 0.01 * seed as f64, 0.004 * seed as f64, seed);
        pair(&settings, &dark, 0.02, seed)
    });
    let scene = FitScene { name: "synthetic".to_owned(), pairs: pairs.collect() };
    assert_beats_the_published_constants(scene);
}

/// A fit without the prior is better than AP3 on its own pairs, but not on others: the exposures of 15 references
/// differ by more than the curves do.
#[test]
fn constants_fitted_to_real_pairs_are_better_than_the_published_ones_on_others() {
    let Some(folder) = shared("data/pairs_lol") else { return };
    let scene = FitScene::load(&folder, None).unwrap();
    assert_eq!(scene.pairs.len(), 15);
    let pairs: Vec<&Pair> = scene.pairs.iter().collect();
    let options = FitOptions { adapt: true, ..FitOptions::default() };
    let seen = fit(&ToneCurve::FittedCubic.into(), &pairs, &options).unwrap();
    assert!(seen.psnr.fitted > seen.psnr.ap3 + 0.3, "{:?}", seen.psnr);
    assert_beats_the_published_constants(scene);
}
