use glam::{DVec2, Vec3};

use crate::gpu::Reference;
use crate::kernels::DepthMoments;
use crate::kernels::depth_moments::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { render, depth, regions, moments }: Slices<'_>) {
        for workgroup in 0..params.chunk_count {
            let (mut region, mut chunk) = (0, workgroup);
            if workgroup >= params.view_chunks {
                let beyond = workgroup - params.view_chunks;
                (region, chunk) = (1 + beyond / params.box_chunks, beyond % params.box_chunks);
            }
            let [left, top, width, height] = regions[region as usize].map(|x| x as usize);
            let value = |i: usize| {
                let at = (top + i / width) * params.width as usize + left + i % width;
                DVec2::new(render[params.first as usize + at].into(), depth[at].into())
            };
            let first = (chunk * params.chunk_size) as usize;
            let end = (width * height).min(first + params.chunk_size as usize);
            let values: Vec<DVec2> = (first..end).map(|i| value(i) - value(0)).collect();
            let mean = values.iter().sum::<DVec2>() / values.len() as f64;
            let sum = |of: fn(DVec2) -> f64| values.iter().map(|&v| of(v - mean)).sum::<f64>();
            let products = [sum(|d| d.x * d.x), sum(|d| d.x * d.y), sum(|d| d.y * d.y)];
            moments[workgroup as usize] = DepthMoments {
                mean: mean.as_vec2(),
                products: Vec3::from_array(products.map(|p| p as f32)),
            };
        }
    }
}
