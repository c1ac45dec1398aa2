//! Curves in configurations of runs, and formulas on the device.

use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{CurveChoice, InverseTone, MeasuredPhotograph};

use crate::common::command::says;
use crate::common::prelude::*;

fn settings(text: &str) -> ToneSettings {
    text.parse::<CurveChoice>().unwrap().settings().unwrap_or_else(|error| panic!("{error}"))
}

/// A curve read from a file with this name and text.
fn load(name: &str, text: &str) -> ToneSettings {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    fs::write(&path, text).unwrap();
    path.to_str().unwrap().parse::<CurveChoice>().unwrap().settings().unwrap()
}

#[test]
fn a_configuration_contains_the_whole_curve() {
    let csv = load("a.csv", "0,0.1\n0.30000000000000004,0.7\n1,1\n");
    let constants = vec![0.1 + 0.2, -1.0 / 3.0, 1.0, 1e-3];
    let cubic = ToneSettings { constants, ..ToneSettings::new(ToneCurve::FittedCubic) };
    for tone in [csv, cubic, ToneSettings::new(ToneCurve::PerChannel)] {
        let config = TrainConfig { tone, ..TrainConfig::bare() };
        let text = config.to_toml().unwrap();
        assert_eq!(toml::from_str::<TrainConfig>(&text).unwrap(), config, "{text}");
        // A run's configuration is also a curve file.
        assert_eq!(load("config.toml", &text), config.tone);
    }
}

#[test]
fn configurations_of_earlier_versions_load() {
    let text = "steps = 7\n[tone]\ncurve = \"ase\"\ngain_c = 3.0\ntheta = 0.49\nalpha = 0.12\nbeta = 2.5\n\
                base_gain = 1.0\n";
    let config: TrainConfig = toml::from_str(text).unwrap();
    assert_eq!(config.tone, ToneSettings::new(ToneCurve::Ase));
}

#[test]
fn kernels_apply_a_formula_to_a_hundredth_of_a_code_and_its_inverse_undoes_it() {
    let photograph = Image::from_fn(64, 64, |x, y| {
        [((64 * y + x) as f32 / 4095.0).powi(2), x as f32 / 640.0, y as f32 / 6400.0]
    });
    let measured = MeasuredPhotograph::measure(&photograph.data);
    for text in ["0.9*t/(t+0.3)", "x^0.45", "1-exp(-1.3*t^0.8)", "min(0.05+0.4*t, 0.9)"] {
        let settings = settings(text);
        let curve = SceneTone::new(&settings).curve_of(&measured);
        let pseudo_gt = PseudoGt::new(&gpu(), &settings).unwrap();
        let mapped = pseudo_gt.tone_mapped(&photograph, &curve).unwrap();
        let inverse = InverseTone::new(&settings, &curve).unwrap();
        for (&x, &y) in photograph.data.iter().zip(&mapped.data) {
            let t = f64::from(x) / f64::from(measured.statistics.p90);
            let expected = settings.value(t, &measured.statistics);
            // Except at the corner of min, where a knot of the table may miss the curve by half of a step of it.
            let bound = if text.starts_with("min") { 1.0 } else { 0.01 } / 255.0;
            assert!((f64::from(y) - expected).abs() < bound, "{text} at {x}: {y}, not {expected}");
            if y > 0.01 && y < 0.85 {
                let back = inverse.invert([y.into(); 3])[1];
                assert!((back - f64::from(x)).abs() < 1e-4, "{text}: {x} becomes {back}");
            }
        }
    }
}

#[test]
fn a_configuration_keeps_formula_constants_and_bounds() {
    let mine = settings("a*t/(t+b); a = 0.9; b = 0.3 in 0.01..5");
    let config = TrainConfig { tone: mine.clone(), ..TrainConfig::bare() };
    let text = config.to_toml().unwrap();
    says(&text, &["curve = \"a*t/(t+b)\"", "a = 0.9", "b = [0.01, 5.0]", "b = 0.3"]);
    let read: TrainConfig = toml::from_str(&text).unwrap();
    assert_eq!(read.tone, mine);
    assert_eq!(read.to_toml().unwrap(), text);
    // Constants one by one, and another curve forgets them.
    let other = config.with(&["tone.constants.a=0.5".to_owned()]).unwrap();
    assert_eq!(other.tone.constants, [0.5, 0.3]);
    let other = config.with(&["tone.curve=t^0.45".to_owned()]).unwrap();
    assert_eq!(other.tone, settings("t^0.45"));
    let open = ["tone.curve=a*t", "tone.constants.a=0.7"].map(str::to_owned);
    assert_eq!(config.with(&open).unwrap().tone.constants, [0.7]);
    let missing = config.with(&["tone.curve=a*t".to_owned()]).unwrap_err().to_string();
    assert!(missing.contains("a of `a*t` has no value"), "{missing}");
    let config = config.with(&["tone.curve=gama".to_owned()]);
    assert!(config.unwrap_err().to_string().contains("the nearest is `gamma`"));
    let gamma = "curve = \"gamma\"\nbounds = { a = [0.1, 1.0] }";
    assert!(toml::from_str::<ToneSettings>(gamma).unwrap_err().to_string().contains("no bounds"));
}
