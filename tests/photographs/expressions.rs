//! Curves by a formula of one's own: values, kernels, files, fits, and what is refused.

use std::f64::consts::PI;

use nightsplat_fit::{FitOptions, Pair, fit};
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{CurveChoice, InverseTone, MeasuredPhotograph, Tone};

use crate::common::command::says;
use crate::common::prelude::*;

fn settings(text: &str) -> ToneSettings {
    text.parse::<CurveChoice>().unwrap().settings().unwrap_or_else(|error| panic!("{error}"))
}

fn value(text: &str, t: f64) -> f64 {
    let settings = settings(text);
    settings.value(t, &Statistics { p90: 1.0, ..settings.plain_statistics() })
}

fn refused(text: &str) -> String {
    let found = text.parse::<CurveChoice>().and_then(|choice| choice.settings());
    let message = found.unwrap_err().to_string();
    assert!(!message.contains('\n'), "{message}");
    message
}

#[test]
fn a_formula_has_the_value_that_mathematics_gives_it() {
    let t: f64 = 0.4;
    let cases: [(&str, f64); 16] = [
        ("t", t),
        ("0.2+t*0.5", 0.2 + 0.5 * t),
        ("1 - exp(-t^2)", 1.0 - (-t * t).exp()),
        ("-exp(-t^2) + 1", 1.0 - (-t * t).exp()),
        ("t - 0.1 - 0.1", t - 0.2),
        ("t/2/2", t / 4.0),
        ("t^2^0.5", t.powf(2f64.sqrt())),
        ("t^(1/2)", t.sqrt()),
        ("1 + (t-1)^3", 1.0 + (t - 1.0).powi(3)),
        ("1 - (t+1)^-2", 1.0 - (t + 1.0).powi(-2)),
        ("min(t, 0.3) + max(1e-1, 0)", 0.4),
        ("atan(t)*2/pi", t.atan() * 2.0 / PI),
        ("0.5 + 0.5*tanh(t - 1)", 0.5 + 0.5 * (t - 1.0).tanh()),
        ("0.1 * ln(1 + 9*sqrt(t))", 0.1 * (1.0 + 9.0 * t.sqrt()).ln()),
        ("a*t/(t+b); a = 0.9; b = 0.3 in 0.01..5", 0.9 * t / (t + 0.3)),
        ("x^g; g = 0.5", t.sqrt()),
    ];
    for (text, expected) in cases {
        let found = value(text, t);
        assert!((found - expected).abs() < 1e-12, "{text}: {found}, not {expected}");
    }
}

#[test]
fn kernels_apply_a_formula_to_a_hundredth_of_a_code_and_its_inverse_undoes_it() {
    let photograph = Image::from_fn(64, 64, |x, y| {
        [((64 * y + x) as f32 / 4095.0).powi(2), x as f32 / 640.0, y as f32 / 6400.0]
    });
    let measured = MeasuredPhotograph::measure(&photograph.data);
    for text in ["0.9*t/(t+0.3)", "x^0.45", "1-exp(-1.3*t^0.8)", "min(0.05+0.4*t, 0.9)"] {
        let settings = settings(text);
        let mapping = SceneTone::new(&settings).mapping_of(&measured);
        let pseudo_gt = PseudoGt::new(&gpu(), &settings).unwrap();
        let mapped = pseudo_gt.tone_mapped(&photograph, &mapping).unwrap();
        let inverse = InverseTone::new(&settings, &mapping.parameters).unwrap();
        for (&x, &y) in photograph.data.iter().zip(&mapped.data) {
            let t = f64::from(x) / f64::from(measured.statistics.p90);
            let expected = settings.value(t, &measured.statistics);
            // Except at the corner of min, where a knot of the table may miss the curve by half of a step of it.
            let bound = if text.starts_with("min") { 1.0 } else { 0.01 } / 255.0;
            assert!((f64::from(y) - expected).abs() < bound, "{text} at {x}: {y}, not {expected}");
            if y > 0.01 && y < 0.85 {
                let back = inverse.invert([y.into(); 3]).rgb[1];
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
    let gamma = "curve = \"gamma\"\nbounds = { a = [0.1, 1.0] }";
    assert!(toml::from_str::<ToneSettings>(gamma).unwrap_err().to_string().contains("no bounds"));
}

#[test]
fn what_is_wrong_with_a_formula_is_said_with_the_formula_and_t() {
    for (text, part) in [
        ("1-t", "`1-t` falls at t = 0."),
        ("a*t/(t-b); a = 0.5; b = 1", "`a*t/(t-b)` falls at t = 2."),
        ("ln(t)", "is -inf at t = 0.0000"),
        ("ln(x-0.5)+9", "is NaN at x = 0.0000"),
        ("a*t", "the constant a of `a*t` has no value; write `a*t; a = VALUE`, or fit it"),
        ("a*t; a = 2 in 0..1", "is followed by `a = 2 in 0..1`; write NAME = VALUE"),
        ("a*t; a = 2 in 2..2", "the bounds of a in `a*t` are 2 and 2"),
        ("a*t; b = 2", "has no constant `b`"),
        ("a*t; a: 2", "is followed by `a: 2`; write NAME = VALUE"),
        ("a*t; a = two", "is followed by `a = two`"),
        ("t*x", "contains both t and x"),
        ("a*b", "contains neither t = x / p90 nor x"),
        ("exp(-2*", "the formula `exp(-2*` cannot be read at `"),
        ("2 t", "cannot be read at `t`"),
        ("sinh(t)", "cannot be read at"),
        ("exp(t, 2)", "cannot be read at"),
        ("t**2", "cannot be read at"),
    ] {
        let message = refused(text);
        assert!(message.contains(part), "{text}: {message}");
    }
    // Depth and length are bounded before they are parsed.
    assert!(
        refused(&format!("{}t{}", "(".repeat(400), ")".repeat(400))).contains("300 characters")
    );
    assert_eq!(settings(&format!("{}t{}", "(".repeat(149), ")".repeat(149))).constants.len(), 0);
    let nine = (1..=9).map(|i| format!("c{i}*t+")).collect::<String>() + "t";
    assert!(refused(&nine).contains("9 constants, at most 8"));
}

#[test]
fn a_misspelled_name_gets_the_nearest_and_no_error_of_a_formula() {
    for (name, nearest) in [("gama", "gamma"), ("a3p", "ap3"), ("rein-hard", "reinhard")] {
        let message = refused(name);
        let parts = [format!("unknown curve `{name}`"), format!("the nearest is `{nearest}`")];
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
    }
    let config = TrainConfig::bare().with(&["tone.curve=gama".to_owned()]);
    assert!(config.unwrap_err().to_string().contains("the nearest is `gamma`"));
}

#[test]
fn a_fit_recovers_the_constants_within_their_bounds() {
    let truth = settings("a*t^g/(t^g+b); a = 1.1; b = 0.4; g = 0.8");
    let pairs: Vec<Pair> = (1..4)
        .map(|seed: u32| {
            let dark = Image::from_fn(48, 48, |x, y| {
                let value = ((x * 48 + y + seed * 7) % 2304) as f32 / 2304.0;
                [value, value * value, 0.5 * value].map(|value| 0.05 * value * seed as f32)
            });
            let statistics = Statistics::new(&dark.data);
            let p90 = f64::from(statistics.p90);
            let y = dark.data.iter().map(|&x| truth.value(f64::from(x) / p90, &statistics) as f32);
            let bright = Image { data: y.collect(), ..dark };
            Pair::new(format!("{seed}.png"), &dark, &bright).unwrap()
        })
        .collect();
    let pairs: Vec<&Pair> = pairs.iter().collect();
    let open: Tone = "a*t^g/(t^g+b)".parse().unwrap();
    let found = fit(&open, &pairs, &FitOptions::default()).unwrap();
    for (found, truth) in found.settings.constants.iter().zip(&truth.constants) {
        assert!((found / truth - 1.0).abs() < 0.02, "{found}, not {truth}");
    }
    assert!(found.psnr.fitted > found.psnr.frozen + 10.0, "{:?}", found.psnr);
    // At a bound, and of the stored value.
    let bounded: Tone = "a*t^g/(t^g+b); g = 0.5 in 0.3..0.6".parse().unwrap();
    let at_bound = fit(&bounded, &pairs, &FitOptions::default()).unwrap();
    let g = at_bound.constants.iter().find(|constant| constant.name == "g").unwrap();
    assert!(g.at_bound && (0.3..=0.6).contains(&g.value), "{g:?}");
    let stored: Tone = "(a*x)^g; a = 2 in 0.1..50; g = 0.5 in 0.1..2".parse().unwrap();
    let of_stored = fit(&stored, &pairs, &FitOptions::default()).unwrap();
    assert!(of_stored.psnr.fitted > of_stored.psnr.frozen, "{:?}", of_stored.psnr);
    // Only rows of the table have a black level to adapt.
    let adapted = fit(&open, &pairs, &FitOptions { adapt: true, ..FitOptions::default() });
    assert!(adapted.unwrap_err().to_string().contains("constants of the formula"));
    assert!(fit(&"t^2".parse().unwrap(), &pairs, &FitOptions::default()).is_err());
}
