//! The table of curves: published values, and the claimed properties of each row.

use std::collections::BTreeSet;

use nightsplat_photographs::tone::{FAMILIES, Family, ToneCurve};

use crate::grid::grid;

/// The published values after the clamp, as printed.
const T: [f64; 8] = [0.05, 0.10, 0.25, 0.50, 1.00, 1.50, 2.00, 3.00];
const VALUES: [(&str, [f64; 8]); 23] = [
    ("fitted_cubic", [0.152, 0.198, 0.326, 0.500, 0.732, 0.854, 0.918, 1.00]),
    ("exp_plateau", [0.102, 0.172, 0.329, 0.509, 0.726, 0.850, 0.927, 1.00]),
    ("power_softexp", [0.102, 0.171, 0.329, 0.510, 0.728, 0.845, 0.911, 0.970]),
    ("log_curve", [0.094, 0.169, 0.333, 0.509, 0.719, 0.854, 0.953, 1.00]),
    ("aces_filmic", [0.111, 0.174, 0.328, 0.509, 0.725, 0.849, 0.929, 1.00]),
    ("reinhard", [0.084, 0.157, 0.329, 0.518, 0.727, 0.839, 0.910, 0.994]),
    ("softexp_gamma", [0.105, 0.174, 0.329, 0.508, 0.728, 0.851, 0.924, 0.994]),
    ("rational", [0.104, 0.173, 0.329, 0.509, 0.724, 0.849, 0.931, 1.00]),
    ("poly5_origin", [0.087, 0.163, 0.334, 0.510, 0.726, 0.853, 0.940, 1.00]),
    ("double_exp", [0.074, 0.142, 0.315, 0.522, 0.747, 0.843, 0.884, 0.910]),
    ("gamma", [0.134, 0.198, 0.330, 0.488, 0.720, 0.904, 1.00, 1.00]),
    ("sinh_ratio", [0.088, 0.163, 0.331, 0.513, 0.725, 0.849, 0.921, 0.984]),
    ("hybrid", [0.108, 0.174, 0.328, 0.508, 0.727, 0.849, 0.924, 1.00]),
    ("poly3_origin", [0.075, 0.145, 0.321, 0.526, 0.716, 0.833, 1.00, 1.00]),
    ("softexp_mod", [0.085, 0.159, 0.333, 0.516, 0.715, 0.847, 0.965, 1.00]),
    ("sqrt_blend", [0.143, 0.205, 0.334, 0.486, 0.716, 0.903, 1.00, 1.00]),
    ("tanh_curve", [0.062, 0.124, 0.299, 0.532, 0.763, 0.827, 0.843, 0.847]),
    ("arctan_curve", [0.044, 0.087, 0.202, 0.338, 0.469, 0.526, 0.556, 0.588]),
    ("bezier3", [0.004, 0.016, 0.096, 0.344, 1.00, 1.00, 1.00, 1.00]),
    ("piecewise3", [0.027, 0.055, 0.137, 0.190, 0.438, 1.00, 1.00, 1.00]),
    ("hable", [1.00, 0.909, 0.593, 0.375, 0.216, 0.152, 0.117, 0.080]),
    ("richards", [1.00; 8]),
    ("softexp", [0.077, 0.149, 0.331, 0.553, 0.800, 0.911, 0.960, 0.992]),
];

fn value(family: &Family, t: f64) -> f64 {
    family.curve.value(t, 0.0, 1.0, &family.defaults())
}

#[test]
fn every_family_has_the_published_values_to_their_last_digit() {
    for (name, expected) in VALUES {
        let family = Family::find(name).unwrap();
        for (t, expected) in T.into_iter().zip(expected) {
            let found = value(family, t);
            assert!((found - expected).abs() <= 5.0001e-4, "{name}({t}) = {found}, not {expected}");
        }
    }
}

#[test]
fn the_table_is_in_order_and_its_names_are_unique() {
    let mut names = BTreeSet::new();
    for (number, family) in FAMILIES.iter().enumerate() {
        assert_eq!(family.curve as usize, number, "{}", family.name);
        for name in std::iter::once(&family.name).chain(family.aliases) {
            assert!(names.insert(name), "{name} is there twice");
            assert_eq!(name.parse::<ToneCurve>().unwrap(), family.curve);
        }
        assert!(!family.formula.is_empty() && !family.source.is_empty());
        for constant in family.constants {
            let [low, high] = constant.bounds;
            for value in [constant.default, constant.start] {
                assert!((low..=high).contains(&value), "{} of {}", constant.name, family.name);
            }
            let names = family.formula.split(|c: char| !c.is_alphanumeric());
            assert!(
                names.clone().any(|name| name == constant.name),
                "{} of {}",
                constant.name,
                family.name
            );
        }
    }
    assert_eq!(VALUES.len(), 23);
}

#[test]
fn a_row_has_the_number_of_its_function_in_the_kernel() {
    let source = include_str!("../../../../shaders-glsl/include/curves.glsl");
    let numbers = source.lines().filter_map(|line| {
        let (name, number) = line.strip_prefix("const uint CURVE_")?.split_once('=')?;
        Some((name.trim().to_lowercase(), number.trim().trim_end_matches(';').parse().unwrap()))
    });
    let numbers: Vec<(String, u32)> = numbers.collect();
    for family in &FAMILIES {
        let row = (family.name.replace('-', "_"), family.curve.constant());
        assert!(numbers.contains(&row), "{row:?}");
    }
    assert_eq!(numbers.len(), FAMILIES.len() + 3, "table, auto and profile have no row");
}

#[test]
fn every_value_is_finite_and_in_range_at_every_extreme() {
    for family in &FAMILIES {
        for t in grid().into_iter().chain([f64::NAN, f64::NEG_INFINITY, -1.0]) {
            let y = value(family, t);
            assert!((0.0..=1.0).contains(&y), "{}({t}) = {y}", family.name);
            let shape = family.shape(t, &family.defaults());
            assert!(shape.is_finite(), "{}({t}) = {shape}", family.name);
            assert!(family.derivative(t, &family.defaults()).is_finite(), "{}({t})", family.name);
        }
    }
    let sinh_ratio = Family::find("sinh_ratio").unwrap();
    for t in [65.0, 1e6, f64::INFINITY] {
        assert!((sinh_ratio.shape(t, &sinh_ratio.defaults()) - 1.0067).abs() < 1e-12);
    }
}

#[test]
fn every_row_states_correctly_whether_it_rises_and_whether_it_clips() {
    for family in &FAMILIES {
        let name = family.name;
        let constants = family.defaults();
        let values: Vec<f64> = grid().into_iter().map(|t| value(family, t)).collect();
        let rises = values.windows(2).all(|pair| pair[1] >= pair[0] - 1e-15);
        assert_eq!(rises, family.monotone, "{name}");
        for (offset, gain) in [(0.0, 1.0), (0.12, 1.0), (0.05, 1.3), (0.0, 4.0)] {
            let value = |i| family.curve.value(f64::from(i) / 1000.0, offset, gain, &constants);
            let values: Vec<f64> = (0..4000).map(value).collect();
            assert!(values.is_sorted() || !rises, "{name} falls, offset {offset}, gain {gain}");
            assert!(values.iter().all(|y| (0.0..=1.0).contains(y)), "{name}");
        }
        let highest = grid().into_iter().map(|t| family.shape(t, &constants)).fold(0.0, f64::max);
        let unbounded_law = matches!(family.curve, ToneCurve::AseFloor);
        assert_eq!(highest <= 1.0 && !unbounded_law, family.bounded, "{name} reaches {highest}");
    }
}

/// By central differences, away from knees.
#[test]
fn derivatives_agree_with_central_differences() {
    for family in &FAMILIES {
        let constants = family.defaults();
        for i in 0..400 {
            let t = 0.0037 + f64::from(i) * 0.0113;
            let h = 1e-5 * t.max(0.1);
            let knees = [0.2513, 0.8845, 0.3, 1.2, 2.7, 3.0, 1.0];
            if knees.iter().any(|knee: &f64| (knee - t).abs() <= h) {
                continue;
            }
            let close = |exact: f64, difference: f64, what: &str| {
                assert!(
                    (exact - difference).abs() <= 1e-6 * (1.0 + exact.abs()),
                    "{}({t}), d{what}: {exact}, not {difference}",
                    family.name
                );
            };
            let difference = family.shape(t + h, &constants) - family.shape(t - h, &constants);
            close(family.derivative(t, &constants), difference / (2.0 * h), "t");
            for (index, exact) in family.gradient(t, &constants).into_iter().enumerate() {
                let h = 1e-6 * constants[index].abs().max(1e-3);
                let at = |shift: f64| {
                    let mut constants = constants.clone();
                    constants[index] += shift;
                    family.shape(t, &constants)
                };
                close(exact, (at(h) - at(-h)) / (2.0 * h), &family.constants[index].name);
            }
        }
    }
}
