//! Tone curves and their statistics, against the paper and by their properties.

use std::fs;
use std::path::{Path, PathBuf};

use nightsplat_core::Error;
use nightsplat_photographs::image::{Image, ImageFile as _};
use nightsplat_photographs::tone::{
    CurveChoice, Statistics, Tone, ToneCurve, ToneParameters, ToneSettings, percentiles,
};
use serde_json::Value;

use crate::common::{fixture, says, shared};

/// The paper's curves and none, which the loss evaluates directly.
const PAPER: [ToneCurve; 4] = [ToneCurve::Linear, ToneCurve::Ase, ToneCurve::Ap3, ToneCurve::None];

/// The views of a split, by file name.
fn names(scene: &Path, split: &str) -> Vec<String> {
    let json = fs::read(scene.join(format!("transforms_{split}.json"))).unwrap();
    let json: Value = serde_json::from_slice(&json).unwrap();
    let frames = json["frames"].as_array().unwrap().iter();
    let path = |frame: &Value| PathBuf::from(frame["file_path"].as_str().unwrap());
    frames.map(|frame| path(frame).file_name().unwrap().to_str().unwrap().to_owned()).collect()
}

/// A photograph as planar (3, H, W), as stored.
fn load(path: &Path) -> Vec<f32> {
    Image::load(path).unwrap().data
}

fn psnr(a: &[f32], b: &[f32]) -> f64 {
    let squares: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    -10.0 * (squares / a.len() as f64).log10()
}

/// A reproducible value in [0, 1).
fn noise(state: &mut u64) -> f32 {
    *state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
    (*state >> 40) as f32 / (1u64 << 24) as f32
}

/// The quantile by sorting, in f64.
fn sorted_quantile(values: &[f32], q: f64) -> f64 {
    let mut sorted: Vec<f64> = values.iter().map(|&v| v.into()).collect();
    sorted.sort_by(f64::total_cmp);
    let rank = q * (sorted.len() - 1) as f64;
    let lower = sorted[rank as usize];
    lower + rank.fract() * (sorted[rank.ceil() as usize] - lower)
}

#[test]
fn the_offset_has_the_values_of_the_paper() {
    let settings = ToneSettings::new(ToneCurve::Ap3);
    for (ratio, offset) in
        [(0.37, 0.0378), (0.26, 0.0565), (0.22, 0.0645), (0.17, 0.0753), (0.12, 0.0872)]
    {
        assert!((settings.offset(ratio) - offset).abs() < 5.1e-5, "r = {ratio}");
    }
    assert_eq!(settings.offset(1.0), 0.0);
    assert_eq!(settings.offset(0.0), 0.12);
}

#[test]
fn the_cubic_has_the_values_of_the_paper() {
    let p = |t| ToneCurve::Ap3.value(t, 0.0, 1.0, &[]);
    assert!((p(1.0) - 0.6292).abs() < 1e-12);
    // With delta0 = 0.075, white starts at t = 2.76, 2.42 and 1.97 for b = 1, 1.07 and 1.14.
    for (gain, white) in [(1.0, 2.76), (1.07, 2.42), (1.14, 1.97)] {
        assert!(ToneCurve::Ap3.value(white - 0.01, 0.075, gain, &[]) < 1.0, "b = {gain}");
        assert_eq!(ToneCurve::Ap3.value(white + 0.01, 0.075, gain, &[]), 1.0, "b = {gain}");
    }
}

#[test]
fn ase_starts_at_the_offset_and_never_clips() {
    assert_eq!(ToneCurve::Ase.value(0.0, 0.0753, 1.2, &[]), 0.0753);
    assert!((ToneCurve::Ase.value(1.0, 0.0, 1.0, &[]) - 0.632_120_558_828_557_7).abs() < 1e-15);
    assert!(ToneCurve::Ase.value(20.0, 0.1, 1.2, &[]) < 1.0);
}

#[test]
fn the_f32_curves_agree_with_the_f64_curves() {
    let mut grid: Vec<f32> = (0..=20_000).map(|i| i as f32 / 5000.0).collect();
    grid.extend([0.0, 1e-12, 1e-9, 1e-6, 0.009_999, 0.01, 0.010_001, 65.0, 1e6, f32::MAX]);
    for curve in PAPER {
        for (white, offset, gain) in [(1.0, 0.0, 1.0), (0.0816, 0.0754, 1.16), (1e-6, 0.12, 4.0)] {
            let parameters =
                ToneParameters { white, offset, gain, weight: 1.0, constants: [0.0; 8] };
            for &x in &grid {
                let t = f64::from(x) / f64::from(white);
                let exact = curve.value(t, offset.into(), gain.into(), &[]);
                let error = (f64::from(curve.apply(x, &parameters)) - exact).abs();
                // Relative for tiny values; a few ulps of one otherwise.
                let bound = 4e-7 * if offset == 0.0 && t < 1e-3 { exact } else { 1.0 };
                assert!(error <= bound, "{curve} at {x} / {white}: off by {error:e}");
            }
        }
    }
}

#[test]
fn nan_and_negative_values_map_into_the_range_and_below_black() {
    for curve in ToneCurve::ALL {
        let parameters = ToneSettings::new(curve).parameters(&Statistics::new(&[0.1; 12]));
        for x in [f32::NAN, f32::NEG_INFINITY, -1.0, -1e-9, f32::INFINITY, f32::MAX] {
            let (y, least) = (curve.apply(x, &parameters), if x < 0.0 { -1.0 } else { 0.0 });
            assert!((least..=1.0).contains(&y), "{curve}({x}) = {y}");
        }
        // As a black value, or black.
        let of_nan = curve.apply(f32::NAN, &parameters);
        assert!(of_nan == 0.0 || of_nan == curve.apply(0.0, &parameters), "{curve}: {of_nan}");
    }
    for curve in PAPER {
        let parameters = ToneSettings::new(curve).parameters(&Statistics::new(&[0.1; 12]));
        assert_eq!(curve.apply(f32::NAN, &parameters), 0.0);
        assert_eq!(curve.value(f64::NAN, 0.1, 1.0, &[]), 0.0);
    }
}

#[test]
fn curves_are_found_by_name_in_any_case_and_an_unknown_name_lists_them() {
    for curve in ToneCurve::ALL.map(Tone::Formula).into_iter().chain([Tone::Auto]) {
        assert_eq!(curve.to_string().parse::<Tone>().unwrap(), curve);
    }
    for name in ["AP3", "Ap3", "ap3"] {
        assert_eq!(name.parse::<CurveChoice>().unwrap(), ToneCurve::Ap3.into());
    }
    let error = "gama".parse::<Tone>().unwrap_err();
    assert!(matches!(error, Error::Usage(_)));
    says(&error.to_string(), &["gama", "linear", "ase", "ap3", "none"]);
}

#[test]
fn settings_are_read_back_from_toml() {
    for curve in ToneCurve::ALL {
        let settings = ToneSettings { gain_c: 1.7, ..ToneSettings::new(curve) };
        let text = toml::to_string(&settings).unwrap();
        assert!(text.contains(&format!("curve = \"{curve}\"")), "{text}");
        assert_eq!(toml::from_str::<ToneSettings>(&text).unwrap(), settings);
    }
}

#[test]
fn settings_that_leave_a_curve_undefined_are_refused() {
    let good = ToneSettings::new(ToneCurve::Ap3);
    good.check().unwrap();
    for bad in [
        ToneSettings { gain_c: -0.1, ..good.clone() },
        ToneSettings { gain_c: f64::NAN, ..good.clone() },
        ToneSettings { gain_c: 1e300, ..good.clone() },
        ToneSettings { theta: 0.0, ..good.clone() },
        ToneSettings { theta: f64::INFINITY, ..good.clone() },
        ToneSettings { alpha: 1.1, ..good.clone() },
        ToneSettings { alpha: -0.1, ..good.clone() },
        ToneSettings { beta: -0.1, ..good.clone() },
        ToneSettings { base_gain: 0.0, ..good.clone() },
    ] {
        assert!(matches!(bad.check(), Err(Error::Setting { .. })), "{bad:?}");
    }
}

#[test]
fn percentiles_interpolate_between_the_neighbours_of_the_rank() {
    assert_eq!(percentiles(&mut [3.0, 1.0], [1]), [1.2]);
    assert_eq!(percentiles(&mut [5.0], [1, 9]), [5.0; 2]);
    assert_eq!(percentiles(&mut [], [9]), [0.0]);
    let mut state = 7;
    for count in [2, 3, 9, 10, 11, 12, 20, 21, 1001, 4096] {
        let values: Vec<f32> = (0..count).map(|_| noise(&mut state)).collect();
        let tenths = [0, 1, 5, 9, 9, 10];
        for (tenths, found) in tenths.into_iter().zip(percentiles(&mut values.clone(), tenths)) {
            let exact = sorted_quantile(&values, tenths as f64 / 10.0);
            assert!(
                (f64::from(found) - exact).abs() < 1e-7,
                "{tenths} / 10 of {count}: {found}, not {exact}"
            );
        }
    }
}

#[test]
fn statistics_are_those_of_encoded_bt601_luminance() {
    // Two pixels: pure red, pure blue.
    let statistics = Statistics::new(&[1.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
    assert!((statistics.mean_luminance - (0.299 + 0.114) / 2.0).abs() < 1e-7);
    assert!((statistics.mean - 1.0 / 3.0).abs() < 1e-7);
    assert!((statistics.p10 - (0.114 + 0.1 * 0.185 + 1e-6)).abs() < 1e-7);
    assert!((statistics.p90 - (0.114 + 0.9 * 0.185 + 1e-6)).abs() < 1e-7);
}

#[test]
fn degenerate_photographs_have_finite_curves() {
    let photographs: [(&str, Vec<f32>); 8] = [
        ("no pixels", vec![]),
        ("one black pixel", vec![0.0; 3]),
        ("one white pixel", vec![1.0; 3]),
        ("black", vec![0.0; 300]),
        ("white", vec![1.0; 300]),
        ("constant", vec![0.03; 300]),
        ("one dot in the dark", (0..300).map(|i| f32::from(u8::from(i % 100 == 0))).collect()),
        ("not finite", vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0, 0.5, 1e30]),
    ];
    for (name, planes) in photographs {
        let statistics = Statistics::new(&planes);
        let Statistics { p10, p90, mean_luminance, mean, .. } = statistics;
        assert!(
            [p10, p90, mean_luminance, mean].iter().all(|x| x.is_finite()),
            "{name}: {statistics:?}"
        );
        assert!(p90 >= p10 && p10 >= 1e-6 && (0.0..=1.0).contains(&statistics.ratio()), "{name}");
        for curve in ToneCurve::ALL {
            let parameters = ToneSettings::new(curve).parameters(&statistics);
            assert!(
                parameters.white > 0.0 && parameters.white.is_finite(),
                "{name}: {parameters:?}"
            );
            for x in planes.iter().copied().chain([0.0, 0.5, 1.0]) {
                let (y, least) = (curve.apply(x, &parameters), if x < 0.0 { -1.0 } else { 0.0 });
                assert!((least..=1.0).contains(&y), "{name}: {curve}({x}) = {y}");
            }
        }
    }
}

#[test]
fn a_constant_photograph_has_no_offset_and_black_stays_black() {
    for planes in [[0.0; 12], [0.2; 12], [1.0; 12]] {
        let statistics = Statistics::new(&planes);
        assert_eq!(statistics.ratio(), 1.0);
        for curve in ToneCurve::ALL {
            let parameters = ToneSettings::new(curve).parameters(&statistics);
            assert_eq!(parameters.offset, 0.0);
            let family = curve.family();
            let black = family.shape(0.0, &family.defaults()) as f32;
            assert!((curve.apply(0.0, &parameters) - black.min(1.0)).abs() < 1e-6, "{curve}");
        }
    }
}

#[test]
fn the_linear_curve_scales_the_mean_to_theta() {
    let planes: Vec<f32> = (0..300).map(|i| i as f32 / 6000.0).collect();
    let settings = ToneSettings { theta: 0.3, ..ToneSettings::new(ToneCurve::Linear) };
    let parameters = settings.parameters(&Statistics::new(&planes));
    let sum: f32 = planes.iter().map(|&x| settings.curve.apply(x, &parameters)).sum();
    assert!((sum / 300.0 - 0.3).abs() < 1e-5);
}

/// p10, p90, delta0, the mean luminance and the mean of the committed photographs, computed independently.
const KNOWN_STATISTICS: [(&str, [f64; 5]); 3] = [
    ("000.png", [0.044202, 0.147762, 0.049347, 0.098731, 0.094153]),
    ("001.png", [0.050953, 0.146753, 0.041317, 0.102327, 0.097670]),
    ("002.png", [0.060058, 0.142193, 0.030430, 0.100338, 0.095496]),
];

#[test]
fn the_statistics_agree_with_independent_values() {
    for (name, expected) in KNOWN_STATISTICS {
        let statistics = Statistics::new(&load(&fixture("lom/low").join(name)));
        let [p10, p90] = statistics.percentiles();
        let delta0 = ToneSettings::new(ToneCurve::Ap3).offset(statistics.printed_ratio());
        let means = [statistics.mean_luminance, statistics.mean].map(f64::from);
        for (found, expected) in [p10, p90, delta0].into_iter().chain(means).zip(expected) {
            assert!((found - expected).abs() < 1e-6, "{name}: {found}, not {expected}");
        }
    }
}

#[test]
fn the_training_photographs_have_the_statistics_of_the_paper() {
    let Some(lom) = shared("data/lom") else { return };
    for (scene, expected) in [
        ("chair", [0.0816, 0.170, 0.0754, 0.0521]),
        ("shrub", [0.0725, 0.115, 0.0885, 0.0374]),
        ("sofa", [0.1251, 0.258, 0.0569, 0.0704]),
    ] {
        let names = names(&lom.join(scene), "train");
        let settings = ToneSettings::new(ToneCurve::Ap3);
        let mut mean = [0.0; 4];
        for name in &names {
            let statistics = Statistics::new(&load(&lom.join(scene).join("low").join(name)));
            let ratio = statistics.printed_ratio();
            let values = [
                statistics.percentiles()[1],
                ratio,
                settings.offset(ratio),
                statistics.mean_luminance.into(),
            ];
            for (mean, value) in mean.iter_mut().zip(values) {
                *mean += value / names.len() as f64;
            }
        }
        for ((mean, expected), digit) in mean.iter().zip(expected).zip([1e-4, 1e-3, 1e-4, 1e-4]) {
            assert!((mean - expected).abs() <= 0.51 * digit, "{scene}: {mean}, not {expected}");
        }
    }
}

/// PSNR in dB of a curve, without training, on the test views of chair, sofa and shrub, from libjpeg's pixels.
const CURVE_ALONE: [(ToneCurve, f64, [f64; 3]); 11] = [
    (ToneCurve::Linear, 0.0, [20.68, 19.14, 14.59]),
    (ToneCurve::Ase, 0.0, [22.97, 19.85, 19.56]),
    (ToneCurve::Ase, 1.0, [23.98, 21.61, 19.51]),
    (ToneCurve::Ase, 2.0, [24.64, 23.64, 19.40]),
    (ToneCurve::Ase, 3.0, [24.84, 25.99, 19.24]),
    (ToneCurve::Ase, 4.0, [24.60, 28.44, 19.04]),
    (ToneCurve::Ap3, 0.0, [24.88, 22.20, 19.13]),
    (ToneCurve::Ap3, 1.0, [24.61, 25.71, 18.75]),
    (ToneCurve::Ap3, 2.0, [23.10, 28.42, 18.27]),
    (ToneCurve::Ap3, 3.0, [21.17, 26.83, 17.73]),
    (ToneCurve::Ap3, 4.0, [19.33, 23.52, 17.15]),
];

/// PSNR in dB of a curve, without training, on the committed test view, computed independently.
const KNOWN_PSNR: [(ToneCurve, f64, f64); 5] = [
    (ToneCurve::Linear, 0.0, 23.0533),
    (ToneCurve::Ase, 0.0, 25.7922),
    (ToneCurve::Ase, 3.0, 25.2845),
    (ToneCurve::Ap3, 1.0, 26.4748),
    (ToneCurve::Ap3, 4.0, 15.0251),
];

/// The PSNR of a curve, without training: the mean over the test views.
fn score_of_curve(scene: &Path, curve: ToneCurve, gain_c: f64) -> f64 {
    let settings = ToneSettings { gain_c, ..ToneSettings::new(curve) };
    let names = names(scene, "test");
    let scores = names.iter().map(|name| {
        let [low, high] = ["low", "high"].map(|folder| load(&scene.join(folder).join(name)));
        let parameters = settings.parameters(&Statistics::new(&low));
        let target: Vec<f32> = low.iter().map(|&x| curve.apply(x, &parameters)).collect();
        psnr(&target, &high)
    });
    scores.sum::<f64>() / names.len() as f64
}

#[test]
fn a_curve_without_training_has_its_known_psnr_on_the_test_views() {
    for (curve, gain_c, expected) in KNOWN_PSNR {
        let score = score_of_curve(&fixture("lom"), curve, gain_c);
        assert!((score - expected).abs() < 1e-3, "{curve} c = {gain_c}: {score}");
    }
    let Some(lom) = shared("data/lom") else { return };
    for (column, scene) in ["chair", "sofa", "shrub"].into_iter().enumerate() {
        for (curve, gain_c, expected) in CURVE_ALONE {
            let score = score_of_curve(&lom.join(scene), curve, gain_c);
            let error = (score - expected[column]).abs();
            assert!(error < 0.0075, "{scene} {curve} c = {gain_c}: {score}");
        }
    }
}

/// A fixed gain replaces an automatic one, and changes nothing else.
#[test]
fn a_fixed_gain_replaces_an_automatic_one_and_keeps_full_resolution() {
    let ap3 = ToneSettings::new(ToneCurve::Ap3);
    let auto = ap3.clone().with_gain(None);
    assert!(auto.auto_gain && auto.full_resolution);
    let fixed = |settings: ToneSettings| settings.with_gain(Some(2.0));
    assert_eq!(fixed(auto), ToneSettings { gain_c: 2.0, ..ap3.clone() });
    let tone_mapped = ToneSettings { full_resolution: true, ..ap3 };
    assert_eq!(fixed(tone_mapped.clone()), ToneSettings { gain_c: 2.0, ..tone_mapped });
}

/// Ranks above 2^24 include whole numbers that f32 cannot represent.
#[test]
fn percentiles_and_means_of_more_than_sixteen_million_pixels_are_exact() {
    let pixels = (1 << 24) + 12_346;
    let weight = (8 * (pixels - 1) % 10) as f32 / 10.0;
    let lower = 8 * (pixels - 1) / 10;
    assert!(weight > 0.0, "the percentile lies between two ranks");
    let plane = (0..pixels).map(|i| if pixels - 1 - i <= lower { 0.25 } else { 0.5 });
    let mut luminances: Vec<f32> = plane.collect();
    assert_eq!(percentiles(&mut luminances, [8]), [0.25 + 0.25 * weight]);
    let statistics = Statistics::new(&luminances.repeat(3));
    let mean = 0.25 * (1.0 + (pixels - 1 - lower) as f64 / pixels as f64);
    for found in [statistics.mean, statistics.mean_luminance] {
        assert!((f64::from(found) / mean - 1.0).abs() < 1e-7, "{found}, not {mean}");
    }
}
