//! The Pearson loss in double precision.

use glam::{DVec2, DVec3};

use crate::gpu::Reference;
use crate::kernels::DepthGradient;
use crate::kernels::depth_correlation::{Constants, EPSILON, Kernel, Params, Slices};

/// P, and what multiplies a - mean a and b - mean b in its gradient with respect to a.
#[derive(Clone, Copy, Debug)]
pub struct Pearson {
    /// 1 - correlation.
    pub value: f64,
    /// Of a - mean a.
    pub a_scale: f64,
    /// Of b - mean b.
    pub b_scale: f64,
}

/// P from the sums of aa, ab and bb about the means of `n` values.
pub fn pearson(n: f64, products: DVec3) -> Pearson {
    if products.x == 0.0 || products.z == 0.0 {
        return Pearson { value: 1.0, a_scale: 0.0, b_scale: 0.0 };
    }
    let [deviation_a, deviation_b] = [products.x, products.z].map(|sum| (sum / (n - 1.0)).sqrt());
    let [a, b] = [deviation_a, deviation_b].map(|deviation| deviation + EPSILON);
    let correlation = products.y / (n * a * b);
    Pearson {
        value: 1.0 - correlation,
        a_scale: correlation / (a * (n - 1.0) * deviation_a),
        b_scale: -1.0 / (n * a * b),
    }
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        for (region, &[left, top, width, height]) in slices.regions.iter().enumerate() {
            let (pixels, is_view) = (width * height, region == 0);
            let chunks = match region {
                0 => 0..params.view_chunks,
                _ => {
                    let first = params.view_chunks + (region as u32 - 1) * params.box_chunks;
                    first..first + params.box_chunks
                }
            };
            let counted = || {
                let of = &slices.moments[chunks.start as usize..chunks.end as usize];
                (0..).zip(of).map(|(i, of)| {
                    (f64::from(params.chunk_size.min(pixels - i * params.chunk_size)), of)
                })
            };
            let n = f64::from(pixels);
            let sum: DVec2 = counted().map(|(count, of)| count * of.mean.as_dvec2()).sum();
            let products: DVec3 = counted()
                .map(|(count, of)| {
                    let d = of.mean.as_dvec2() - sum / n;
                    of.products.as_dvec3() + count * DVec3::new(d.x * d.x, d.x * d.y, d.y * d.y)
                })
                .sum();
            let Pearson { value, a_scale, b_scale } = pearson(n, products);
            let weight = f64::from(if is_view { params.view_weight } else { params.box_weight });
            let corner = (top * params.width + left) as usize;
            let pivot = DVec2::new(
                slices.render[params.first as usize + corner].into(),
                slices.depth[corner].into(),
            );
            slices.gradients[region] = DepthGradient {
                mean: (pivot + sum / n).as_vec2(),
                a_scale: (weight * a_scale) as f32,
                b_scale: (weight * b_scale) as f32,
            };
            match region {
                0 => slices.view_values[0] = value as f32,
                _ => slices.box_values[region - 1] = value as f32,
            }
        }
    }
}
