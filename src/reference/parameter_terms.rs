//! Mean opacity and mean standard deviation of the Gaussians, with their gradients.

use super::rounding::{Rounded, chain};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::parameter_terms::{Constants, Kernel, Params, Slices, Tolerances};
use crate::photographs::tone::Real;
use crate::splats::attributes::Attribute;

/// A value that a term sums up, and its derivative with respect to the parameter, in any number.
fn opacity<T: Real>(raw: T) -> [T; 2] {
    let one = T::of(1.0);
    let opacity = one / (one + (-raw).exp());
    [opacity, opacity * (one - opacity)]
}

fn scale<T: Real>(log_scale: T) -> [T; 2] {
    [log_scale.exp(); 2]
}

/// `weights[0]` mean opacity + `weights[1]` mean standard deviation of so many Gaussians with these planes, and its gradient.
#[cfg(feature = "testing")]
pub fn parameter_terms(
    planes: &[f64],
    gaussian_count: usize,
    weights: [f64; 2],
) -> (f64, Vec<f64>) {
    let (mut value, mut gradient) = (0.0, vec![0.0; planes.len()]);
    for (term, range) in [opacities(gaussian_count), scales(gaussian_count)].into_iter().enumerate()
    {
        let weight = weights[term] / range.len() as f64;
        for at in range {
            let [own, derivative] = [opacity, scale][term](planes[at]);
            value += weight * own;
            gradient[at] = weight * derivative;
        }
    }
    (value, gradient)
}

fn opacities(gaussian_count: usize) -> std::ops::Range<usize> {
    let first = Attribute::RawOpacities.column(0) * gaussian_count;
    first..first + gaussian_count
}

fn scales(gaussian_count: usize) -> std::ops::Range<usize> {
    let first = Attribute::LogScales.column(0) * gaussian_count;
    first..first + 3 * gaussian_count
}

/// The values of a term, and what the gradients become.
struct Outcome {
    values: Vec<Rounded>,
    gradients: Vec<(usize, Rounded)>,
}

fn outcomes(params: &Params, slices: &Slices<'_>) -> [Outcome; 2] {
    let count = params.gaussian_count as usize;
    let of = |range: std::ops::Range<usize>, term: fn(Rounded) -> [Rounded; 2], weight: f32| {
        let both = range.map(|at| (at, term(Rounded::exact(slices.parameters[at]))));
        let both: Vec<_> = both.collect();
        let sum = |&(at, [_, derivative]): &(usize, [Rounded; 2])| {
            (at, Rounded::exact(slices.gradients[at]) + Rounded::exact(weight) * derivative)
        };
        let gradients = both.iter().filter(|_| weight > 0.0).map(sum).collect();
        Outcome { values: both.iter().map(|(_, [value, _])| *value).collect(), gradients }
    };
    [
        of(opacities(count), opacity, params.opacity_scale),
        of(scales(count), scale, params.log_scale_scale),
    ]
}

impl Reference for Kernel {
    /// The whole sums go into the first partials: how many there are is the device's choice.
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let outcomes = outcomes(params, &slices);
        for (at, gradient) in outcomes.iter().flat_map(|of| &of.gradients) {
            slices.gradients[*at] = gradient.value as f32;
        }
        for (partials, Outcome { values, .. }) in
            [slices.opacity_partials, slices.scale_partials].into_iter().zip(&outcomes)
        {
            partials.fill(0.0);
            partials[0] = values.iter().map(|value| value.value).sum::<f64>() as f32;
        }
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let outcomes = outcomes(params, &slices);
        let mut bounds = vec![0.0; slices.gradients.len()];
        for (at, gradient) in outcomes.iter().flat_map(|of| &of.gradients) {
            bounds[*at] = gradient.bound();
        }
        let chain = chain(0) + f64::from(3 * constants.gaussians_per_thread);
        let [opacity_partials, scale_partials] =
            outcomes.map(|of| Tolerance::Sum(Rounded::sum(chain, of.values).bound()));
        Tolerances { gradients: Tolerance::Each(bounds), opacity_partials, scale_partials }
    }
}
