//! The sum of all Gaussians' shares of the camera's gradient.

use super::rounding::{Rounded, chain, values};
use crate::gpu::Reference;
use crate::kernels::camera::CAMERA_WIDTH;
use crate::kernels::camera_gradient::{Constants, Kernel, Params, Slices, Tolerances};

fn sums(params: &Params, shares: &[f32]) -> Vec<Rounded> {
    let (count, width) = (params.gaussian_count as usize, CAMERA_WIDTH as usize);
    let sum = |number: usize| {
        let own = shares[..count * width].iter().skip(number).step_by(width);
        Rounded::sum(chain(count), own.map(|&share| Rounded::exact(share)))
    };
    (0..width).map(sum).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let sums = values(sums(params, slices.shares));
        slices.gradient.iter_mut().zip(sums).for_each(|(to, sum)| *to = sum);
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances { gradient: sums(params, slices.shares).into_iter().collect() }
    }
}
