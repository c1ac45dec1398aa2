//! The Pearson loss, in any number type.

use nightsplat_photographs::tone::Real;

use super::rounding::{Rounded, bounded_reference, chain};
use crate::kernels::depth_correlation::{Constants, EPSILON, Kernel, Params, Slices, Tolerances};

/// P, and the factors of a - mean a and b - mean b in its gradient with respect to a.
#[derive(Clone, Copy, Debug)]
pub struct Pearson<T> {
    /// 1 - correlation.
    pub value: T,
    /// Of a - mean a.
    pub a_scale: T,
    /// Of b - mean b.
    pub b_scale: T,
}

/// P from the sums of aa, ab and bb about the means of `n` values.
pub fn pearson<T: Real>(n: f64, [aa, ab, bb]: [T; 3]) -> Pearson<T> {
    let (zero, one) = (T::from_f64(0.0), T::from_f64(1.0));
    if aa == zero || bb == zero {
        return Pearson { value: one, a_scale: zero, b_scale: zero };
    }
    let [all, others] = [T::from_f64(n), T::from_f64(n - 1.0)];
    let [deviation_a, deviation_b] = [aa, bb].map(|sum| (sum / others).sqrt());
    let [a, b] = [deviation_a, deviation_b].map(|deviation| deviation + T::from_f64(EPSILON));
    let correlation = ab / all / a / b;
    Pearson {
        value: one - correlation,
        a_scale: correlation / a / (others * deviation_a),
        b_scale: -one / all / a / b,
    }
}

/// Mean of a and of b, scales of a and of b, then P, of one region.
fn correlation(params: &Params, slices: &Slices<'_>, region: usize) -> [Rounded; 5] {
    let [left, top, width, height] = slices.regions[region];
    let pixels = width * height;
    let (first, count, weight) = match region as u32 {
        0 => (0, params.view_chunks, params.view_weight),
        region => {
            let first = params.view_chunks + (region - 1) * params.box_chunks;
            (first, params.box_chunks, params.box_weight)
        }
    };
    let (chain, n) = (chain(count as usize), Rounded::from_f64(pixels.into()));
    let chunks = || {
        let of = &slices.moments[first as usize..][..count as usize];
        (0..).zip(of).map(|(i, of)| {
            let values = params.chunk_size.min(pixels - i * params.chunk_size);
            (Rounded::from_f64(values.into()), of.mean.to_array().map(Rounded::exact), of.products)
        })
    };
    let mean =
        [0, 1].map(|c| Rounded::sum(chain, chunks().map(|(count, mean, _)| count * mean[c])) / n);
    let products = [(0, 0), (0, 1), (1, 1)].map(|(c, d)| {
        let term = |(count, of, products): (Rounded, [Rounded; 2], glam::Vec3)| {
            let about = count * ((of[c] - mean[c]) * (of[d] - mean[d]));
            Rounded::exact(products[c + d]) + about
        };
        Rounded::sum(chain, chunks().map(term))
    });
    let corner = (top * params.width + left) as usize;
    let pivot = [slices.render[params.first as usize + corner], slices.depth[corner]];
    let Pearson { value, a_scale, b_scale } = pearson(pixels.into(), products);
    let weight = Rounded::exact(weight);
    let mean = [0, 1].map(|c| mean[c] + Rounded::exact(pivot[c]));
    [mean[0], mean[1], weight * a_scale, weight * b_scale, value]
}

/// The gradients of all regions, the view first, then the values of the view and of the boxes.
fn correlations(params: &Params, _: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 3] {
    let regions = 0..params.region_count as usize;
    let regions: Vec<_> = regions.map(|region| correlation(params, slices, region)).collect();
    let values = |regions: &[[Rounded; 5]]| regions.iter().map(|of| of[4]).collect();
    let gradients = regions.iter().flat_map(|of| of[..4].iter().copied()).collect();
    [gradients, values(&regions[..1]), values(&regions[1..])]
}

bounded_reference!(correlations: gradients, view_values, box_values);
