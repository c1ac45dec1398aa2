//! SSIM and its derivatives with respect to the blurred moments.

use super::inside;
use super::rounding::{Rounded, chain, sum_tolerance, write, write_sum};
use super::ssim::{SsimPixel, rounded_ssim};
use crate::gpu::Reference;
use crate::kernels::ssim_forward::{Constants, Kernel, Params, Slices, Tolerances};

fn indices(params: &Params, slices: &Slices<'_>) -> Vec<SsimPixel<Rounded>> {
    let size = [params.width as usize, params.height as usize];
    let counts = |i| inside(i, [params.width, params.height], [params.loss_begin, params.loss_end]);
    let pixels = size[0] * size[1];
    let of_channel = |channel: usize| {
        let plane = |image: &[f32]| Rounded::all(&image[channel * pixels..][..pixels]);
        rounded_ssim(size, &plane(slices.render), &plane(slices.target), counts)
    };
    (0..3).flat_map(of_channel).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let indices = indices(params, &slices);
        let planes = [slices.d_mean, slices.d_square, slices.d_product];
        for (m, plane) in planes.into_iter().enumerate() {
            write(indices.iter().map(|of| of.d_moments[m]), plane);
        }
        write_sum(indices.iter().map(|of| of.value.value), slices.partials);
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let indices = indices(params, &slices);
        let derivative = |m: usize| indices.iter().map(|of| of.d_moments[m]).collect();
        let chain = chain(0) + f64::from(params.rows);
        Tolerances {
            d_mean: derivative(0),
            d_square: derivative(1),
            d_product: derivative(2),
            partials: sum_tolerance(chain, indices.iter().map(|of| of.value)),
        }
    }
}
