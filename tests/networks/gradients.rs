//! The networks' gradients in double precision against central differences.

use super::model::{Denoiser, Gradients, Tonemapper};
use crate::common::prelude::*;

/// Compares the central difference of `loss` in every element of `at` with `gradient`, relative to its largest.
fn check(what: &str, at: &[f64], gradient: &[f64], loss: &dyn Fn(&[f64]) -> f64) {
    assert_eq!(at.len(), gradient.len());
    let largest = gradient.iter().fold(0.0, |largest: f64, g| largest.max(g.abs()));
    assert!(largest > 1e-6, "{what}: the test has no gradient to speak of");
    let step = 1e-6;
    for i in 0..at.len() {
        let moved = |by: f64| {
            let mut at = at.to_vec();
            at[i] += by;
            loss(&at)
        };
        let numeric = (moved(step) - moved(-step)) / (2.0 * step);
        let error = (numeric - gradient[i]).abs();
        assert!(error < 1e-6 * largest, "{what}[{i}]: {numeric} {} of {largest}", gradient[i]);
    }
}

/// Parameters and two inputs to an output.
type Forward<'a> = &'a dyn Fn(&[f64], &[f64], &[f64]) -> Vec<f64>;

fn check_all(forward: Forward<'_>, gradients: &Gradients, [values, first, second, d]: [&[f64]; 4]) {
    let loss = |output: Vec<f64>| output.iter().zip(d).map(|(o, d)| o * d).sum::<f64>();
    check("values", values, &gradients.parameters, &|at| loss(forward(at, first, second)));
    check("first", first, &gradients.inputs[0], &|at| loss(forward(values, at, second)));
    if gradients.inputs[1].iter().any(|d| *d != 0.0) {
        check("second", second, &gradients.inputs[1], &|at| loss(forward(values, first, at)));
    } else {
        let moved: Vec<f64> = second.iter().map(|at| at + 0.1).collect();
        assert_eq!(forward(values, first, second), forward(values, first, &moved));
    }
}

#[test]
fn the_gradient_of_the_denoiser_agrees_with_finite_differences() {
    let sizes = [([4, 3], 1), ([3, 5], 2), ([4, 4], 3)];
    let variants = [NetworkVariant::Identity, NetworkVariant::Paper];
    for ((size, stages), variant) in
        sizes.into_iter().flat_map(|s| variants.map(|variant| (s, variant)))
    {
        let settings =
            DenoiserSettings { stages, repeats: 2, channels: 4, variant, ..Default::default() };
        let denoiser = Denoiser { settings, size };
        let mut random = Random::new(11 + u64::from(stages));
        let mut draw = |count: usize, low: f64, high: f64| -> Vec<f64> {
            (0..count).map(|_| random.between(low, high)).collect()
        };
        let per_stage = 4 * 28 + 4 * 37 + 8 + 3 * 37;
        let values = draw(stages as usize * per_stage, -0.3, 0.3);
        let pixels = size[0] * size[1];
        // So bright that every stage clamps some of its values.
        let noise = draw(3 * pixels, 0.0, 0.5);
        let render = draw(3 * pixels, 0.4, 1.9);
        let d = draw(3 * pixels, -1.0, 1.0);
        let denoised = denoiser.forward(&values, &noise, &render);
        let clamped = denoised.iter().filter(|r| **r == 0.0 || **r == 1.0).count();
        let clamps = (1..2 * pixels).contains(&clamped);
        assert_eq!(clamps, variant == NetworkVariant::Paper, "{clamped} of {} clamp", 3 * pixels);
        let gradients = denoiser.backward(&values, &noise, &render, &d);
        let forward =
            |values: &[f64], noise: &[f64], render: &[f64]| denoiser.forward(values, noise, render);
        check_all(&forward, &gradients, [&values, &noise, &render, &d]);
    }
}

#[test]
fn the_gradient_of_the_tonemapper_agrees_with_finite_differences() {
    for variant in [NetworkVariant::Identity, NetworkVariant::Paper] {
        check_tonemapper(Tonemapper { variant, size: [4, 3] });
    }
}

fn check_tonemapper(tonemapper: Tonemapper) {
    let mut random = Random::new(21);
    let mut draw = |count: usize, low: f64, high: f64| -> Vec<f64> {
        (0..count).map(|_| random.between(low, high)).collect()
    };
    let values = draw(16 * 28 + 16 * 145 + 3 * 145, -0.3, 0.3);
    let [illumination, denoised] = [(); 2].map(|()| draw(36, 0.0, 1.0));
    let d = draw(36, -1.0, 1.0);
    let gradients = tonemapper.backward(&values, &illumination, &denoised, &d);
    let forward = |values: &[f64], a: &[f64], b: &[f64]| tonemapper.forward(values, a, b);
    check_all(&forward, &gradients, [&values, &illumination, &denoised, &d]);
}
