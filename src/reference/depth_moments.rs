use nightsplat_photographs::tone::Real;

use super::rounding::{Rounded, bounded_reference, chain};
use crate::kernels::depth_moments::{Constants, Kernel, Params, Slices, Tolerances};

/// Means of a and b, then the sums of aa, ab and bb about them, of every chunk.
fn moments(params: &Params, _: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 1] {
    let of_chunk = |workgroup| {
        let (mut region, mut chunk) = (0, workgroup);
        if workgroup >= params.view_chunks {
            let beyond = workgroup - params.view_chunks;
            (region, chunk) = (1 + beyond / params.box_chunks, beyond % params.box_chunks);
        }
        let [left, top, width, height] = slices.regions[region as usize].map(|x| x as usize);
        let value = |i: usize| {
            let at = (top + i / width) * params.width as usize + left + i % width;
            [slices.render[params.first as usize + at], slices.depth[at]].map(Rounded::exact)
        };
        let [pivot_a, pivot_b] = value(0);
        let first = (chunk * params.chunk_size) as usize;
        let end = (width * height).min(first + params.chunk_size as usize);
        let values: Vec<[Rounded; 2]> =
            (first..end).map(value).map(|[a, b]| [a - pivot_a, b - pivot_b]).collect();
        let (chain, count) = (chain(values.len()), Rounded::from_f64(values.len() as f64));
        let mean = [0, 1].map(|c| Rounded::sum(chain, values.iter().map(|v| v[c])) / count);
        let [aa, ab, bb] = [(0, 0), (0, 1), (1, 1)].map(|(c, d)| {
            let products = values.iter().map(|v| (v[c] - mean[c]) * (v[d] - mean[d]));
            Rounded::sum(chain, products)
        });
        [mean[0], mean[1], aa, ab, bb]
    };
    [(0..params.chunk_count).flat_map(of_chunk).collect()]
}

bounded_reference!(moments: moments);
