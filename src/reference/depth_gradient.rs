use crate::gpu::Reference;
use crate::kernels::depth_gradient::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let (size, first) = (params.size, params.first as usize);
        for i in 0..(size.x * size.y) as usize {
            let (x, y) = (i as u32 % size.x, i as u32 / size.x);
            let [a, b] = [slices.render[first + i], slices.depth[i]].map(f64::from);
            let regions = slices.regions.iter().zip(slices.gradients);
            let around = |&(&[left, top, width, height], _): &(&[u32; 4], _)| {
                (left..left + width).contains(&x) && (top..top + height).contains(&y)
            };
            let d: f64 = regions
                .take(params.region_count as usize)
                .filter(around)
                .map(|(_, gradient)| {
                    f64::from(gradient.a_scale) * (a - f64::from(gradient.mean.x))
                        + f64::from(gradient.b_scale) * (b - f64::from(gradient.mean.y))
                })
                .sum();
            slices.d_render[first + i] = d as f32;
        }
    }
}
