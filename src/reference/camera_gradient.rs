//! The sum of all Gaussians' shares of the camera's gradient.

use super::rounding::{Rounded, bounded_reference, chain};
use crate::kernels::camera::CAMERA_WIDTH;
use crate::kernels::camera_gradient::{Constants, Kernel, Params, Slices, Tolerances};

fn sums(params: &Params, _: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 1] {
    let (count, width) = (params.gaussian_count as usize, CAMERA_WIDTH as usize);
    let sum = |number: usize| {
        let shares = slices.shares[..count * width].iter().skip(number).step_by(width);
        Rounded::sum(chain(count), shares.map(|&share| Rounded::exact(share)))
    };
    [(0..width).map(sum).collect()]
}

bounded_reference!(sums: gradient);
