//! Clouds of Gaussians, and what their merging keeps.

#![allow(dead_code, reason = "no test binary uses everything")]

use glam::{DMat3, DQuat};
use nightsplat_core::random::Stream;
use nightsplat_models::gaussians::Gaussians;

/// A cloud around the origin.
pub(crate) fn cloud(count: usize, sh_degree: u32, seed: u64) -> Gaussians {
    drawn(count, sh_degree, Stream::new(seed, 13))
}

/// [`cloud`] of other random numbers.
pub(crate) fn drawn(count: usize, sh_degree: u32, stream: Stream) -> Gaussians {
    let mut gaussians = Gaussians::zeros(count, sh_degree);
    for (index, value) in (0..).zip(&mut gaussians.parameters) {
        *value = (stream.uniform(index) * 2.0 - 1.0) as f32;
    }
    gaussians.log_scales_mut().iter_mut().for_each(|scale| *scale = *scale * 0.5 - 2.5);
    gaussians.rest_mut().iter_mut().for_each(|value| *value *= 0.3);
    gaussians
}

pub(crate) fn covariance(gaussians: &Gaussians, index: usize) -> DMat3 {
    let [w, x, y, z] = gaussians.quats()[index].map(f64::from);
    let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scales = gaussians.log_scales()[index].as_dvec3().exp();
    axes * DMat3::from_diagonal(scales * scales) * axes.transpose()
}

pub(crate) fn opacity(gaussians: &Gaussians, index: usize) -> f64 {
    1.0 / (1.0 + (-f64::from(gaussians.raw_opacities()[index])).exp())
}

pub(crate) fn raw(opacity: f64) -> f32 {
    (opacity / (1.0 - opacity)).ln() as f32
}

/// The largest difference of two matrices, as a share of the largest number of the second.
pub(crate) fn relative(a: DMat3, b: DMat3) -> f64 {
    let [a, b] = [a, b].map(|matrix| matrix.to_cols_array());
    let largest = b.iter().fold(0.0_f64, |most, value| most.max(value.abs()));
    a.iter().zip(b).fold(0.0_f64, |most, (a, b)| most.max((a - b).abs())) / largest
}
