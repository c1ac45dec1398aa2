use super::rounding::{Rounded, bounds_from, write};
use crate::gpu::Reference;
use crate::kernels::depth_gradient::{Constants, Kernel, Params, Slices, Tolerances};

/// The gradient of every pixel: the sum over the regions that contain it.
fn d_depths(params: &Params, slices: &Slices<'_>) -> Vec<Rounded> {
    let (size, count) = (params.size, params.region_count as usize);
    let regions = || slices.regions.iter().zip(slices.gradients).take(count);
    let pixel = |i: usize| {
        let (x, y) = (i as u32 % size.x, i as u32 / size.x);
        let around = |&(&[left, top, width, height], _): &(&[u32; 4], _)| {
            (left..left + width).contains(&x) && (top..top + height).contains(&y)
        };
        let at = [slices.render[params.first as usize + i], slices.depth[i]].map(Rounded::exact);
        let terms = regions().filter(around).map(|(_, of)| {
            let [a, b] = [0, 1].map(|c| at[c] - Rounded::exact(of.mean[c]));
            Rounded::exact(of.a_scale) * a + Rounded::exact(of.b_scale) * b
        });
        Rounded::sum(count as f64, terms)
    };
    (0..size.element_product() as usize).map(pixel).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let gradients = d_depths(params, &slices);
        write(gradients, &mut slices.d_render[params.first as usize..]);
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances { d_render: bounds_from(params.first as usize, d_depths(params, &slices)) }
    }
}
