//! Curves by a formula of one's own: values, and what is refused.

use std::f64::consts::PI;

use nightsplat_photographs::tone::{CurveChoice, Statistics, ToneSettings};

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
}
