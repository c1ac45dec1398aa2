//! Mean opacity, mean standard deviation and anisotropy of the Gaussians, with their gradients.

use std::ops::Range;

use nightsplat_models::attributes::Attribute;
use nightsplat_photographs::tone::Real;

use super::rounding::{Rounded, chain, sum_tolerance, write, write_sum};
use crate::gpu::Reference;
use crate::kernels::parameter_terms::{Constants, Kernel, Params, Slices, Tolerances};
use crate::splats::batches::frozen_floats;

/// A value that a term sums, and its derivative with respect to the parameter, in any number type.
fn opacity<T: Real>(raw: T) -> [T; 2] {
    let one = T::from_f64(1.0);
    let opacity = one / (one + (-raw).exp());
    [opacity, opacity * (one - opacity)]
}

fn scale<T: Real>(log_scale: T) -> [T; 2] {
    [log_scale.exp(); 2]
}

/// The axes of the longest and the shortest of three standard deviations, the first of equal ones.
fn extremes<T: PartialOrd + Copy>(log_scales: [T; 3]) -> [usize; 2] {
    (1..3).fold([0, 0], |[longest, shortest], axis| {
        [
            if log_scales[axis] > log_scales[longest] { axis } else { longest },
            if log_scales[axis] < log_scales[shortest] { axis } else { shortest },
        ]
    })
}

/// The three weights, of opacity, standard deviation and anisotropy, times the means over the Gaussians with these
/// planes, and the gradient. `log_ratio` is the logarithm of the largest ratio without a loss.
pub fn parameter_terms(
    planes: &[f64],
    gaussian_count: usize,
    weights: [f64; 3],
    log_ratio: f64,
) -> (f64, Vec<f64>) {
    let (mut value, mut gradient) = (0.0, vec![0.0; planes.len()]);
    for (term, range) in [opacities(gaussian_count), scales(gaussian_count)].into_iter().enumerate()
    {
        let weight = weights[term] / range.len() as f64;
        for at in range {
            let [summed, derivative] = [opacity, scale][term](planes[at]);
            value += weight * summed;
            gradient[at] = weight * derivative;
        }
    }
    let weight = weights[2] / gaussian_count as f64;
    for first in scales(gaussian_count).step_by(3) {
        let [longest, shortest] = extremes([planes[first], planes[first + 1], planes[first + 2]])
            .map(|axis| first + axis);
        let excess = planes[longest] - planes[shortest] - log_ratio;
        if excess > 0.0 {
            value += weight * excess;
            gradient[longest] += weight;
            gradient[shortest] -= weight;
        }
    }
    (value, gradient)
}

fn opacities(gaussian_count: usize) -> Range<usize> {
    let first = Attribute::RawOpacities.column(0) * gaussian_count;
    first..first + gaussian_count
}

fn scales(gaussian_count: usize) -> Range<usize> {
    let first = Attribute::LogScales.column(0) * gaussian_count;
    first..first + 3 * gaussian_count
}

/// The values of the terms, and the updated gradients.
struct ParameterTermValues {
    opacities: Vec<Rounded>,
    scales: Vec<Rounded>,
    ratios: Vec<Rounded>,
    gradients: Vec<Rounded>,
}

fn outcome(params: &Params, constants: &Constants, slices: &Slices<'_>) -> ParameterTermValues {
    let count = params.gaussian_count as usize;
    let frozen = constants.frozen_columns as usize * count;
    let left_out = frozen_floats(constants.frozen_columns, count);
    let parameter = |at: usize| Rounded::exact(slices.parameters[at]);
    let mut gradients = Rounded::all(slices.gradients);
    let mut of = |range: Range<usize>, term: fn(Rounded) -> [Rounded; 2], weight: f32| {
        let value = |at: usize| {
            let [value, derivative] = term(parameter(at));
            if weight > 0.0 && at >= frozen {
                let at = at - left_out;
                gradients[at] = gradients[at] + Rounded::exact(weight) * derivative;
            }
            value
        };
        range.map(value).collect()
    };
    let opacities = of(opacities(count), opacity, params.opacity_scale);
    let all_scales = of(scales(count), scale, params.log_scale_scale);
    let mut ratios = vec![];
    for first in scales(count).step_by(3) {
        let [a, b, c] = [0, 1, 2].map(|axis| slices.parameters[first + axis]);
        let [longest, shortest] = extremes([a, b, c]).map(|axis| first + axis);
        let excess = parameter(longest) - parameter(shortest) - Rounded::exact(params.log_ratio);
        // The kernel decides by its own rounded excess.
        let is_over = slices.parameters[longest] - slices.parameters[shortest] - params.log_ratio;
        if is_over > 0.0 {
            ratios.push(excess);
            if params.ratio_scale > 0.0 && first >= frozen {
                let weight = Rounded::exact(params.ratio_scale);
                let [longest, shortest] = [longest, shortest].map(|at| at - left_out);
                gradients[longest] = gradients[longest] + weight;
                gradients[shortest] = gradients[shortest] - weight;
            }
        }
    }
    ParameterTermValues { opacities, scales: all_scales, ratios, gradients }
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let ParameterTermValues { opacities, scales, ratios, gradients } =
            outcome(params, constants, &slices);
        write(gradients, slices.gradients);
        let partials = [slices.opacity_partials, slices.scale_partials, slices.ratio_partials];
        for (partials, values) in partials.into_iter().zip([opacities, scales, ratios]) {
            write_sum(values.iter().map(|value| value.value), partials);
        }
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let ParameterTermValues { opacities, scales, ratios, gradients } =
            outcome(params, constants, &slices);
        // A gradient that no term adds to keeps its bits.
        let bound = |(gradient, &before): (&Rounded, &f32)| {
            if gradient.value == f64::from(before) { 0.0 } else { gradient.bound() }
        };
        let chain = chain(0) + f64::from(3 * constants.gaussians_per_thread);
        let [opacity_partials, scale_partials, ratio_partials] =
            [opacities, scales, ratios].map(|values| sum_tolerance(chain, values));
        Tolerances {
            gradients: gradients.iter().zip(slices.gradients.iter()).map(bound).collect(),
            opacity_partials,
            scale_partials,
            ratio_partials,
        }
    }
}
