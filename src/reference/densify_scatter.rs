use std::f32::consts::TAU;

use glam::{Quat, Vec3};

use super::random::random_bits;
use super::rounding::{TRIGONOMETRIC, UNIT};
use crate::attributes::{Attribute, planes};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::densify_scatter::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::fate::{FATE_CLONE, FATE_KEEP, FATE_SPLIT};

fn random_uniform(key: u32) -> f32 {
    ((random_bits(key) >> 8) + 1) as f32 / 16_777_216.0
}

fn random_normal3(key: u32) -> Vec3 {
    let uniform = |draw: u32| random_uniform(key.wrapping_add(draw));
    let radius = [0, 1].map(|draw| (-2.0 * uniform(draw).ln()).sqrt());
    let angle = [2, 3].map(|draw| TAU * uniform(draw));
    Vec3::new(radius[0] * angle[0].cos(), radius[0] * angle[0].sin(), radius[1] * angle[1].cos())
}

/// The copies of every Gaussian: whose, which, where they go, and whether each is new.
fn copies<'a>(
    params: &Params,
    slices: &'a Slices<'_>,
) -> impl Iterator<Item = (usize, u32, usize, bool)> + use<'a> {
    (0..params.gaussian_count as usize).flat_map(move |i| {
        let fate = slices.fates[i];
        let count = match fate {
            FATE_CLONE | FATE_SPLIT => 2,
            FATE_KEEP => 1,
            _ => 0,
        };
        (0..count).map(move |copy| {
            let to = slices.offsets[i] as usize + copy as usize;
            (i, copy, to, fate == FATE_SPLIT || copy > 0)
        })
    })
}

/// A draw from the normal distribution that Gaussian `i` is.
fn draw_mean(params: &Params, parameters: &[f32], i: usize, copy: u32) -> Vec3 {
    let n = params.gaussian_count as usize;
    let first = |attribute: Attribute| attribute.column(0) * n;
    let mean = Vec3::from_slice(&parameters[first(Attribute::Means) + 3 * i..]);
    let quat = &parameters[first(Attribute::Quats) + 4 * i..];
    let quat = Quat::from_xyzw(quat[1], quat[2], quat[3], quat[0]);
    let rotation = if quat.length() > 1e-12 { quat.normalize() } else { Quat::IDENTITY };
    let scales = Vec3::from_slice(&parameters[first(Attribute::LogScales) + 3 * i..]).exp();
    let step_key = random_bits(random_bits(params.seed).wrapping_add(params.step));
    let key = random_bits(step_key.wrapping_add(2 * i as u32 + copy));
    mean + rotation * (scales * random_normal3(key))
}

/// Where the planes of means and log scales of `count` Gaussians begin.
fn drawn(count: usize) -> [usize; 2] {
    [Attribute::Means, Attribute::LogScales].map(|attribute| attribute.column(0) * count)
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let (n, new_n) = (params.gaussian_count as usize, params.new_gaussian_count as usize);
        let [features, columns] = [params.feature_count, params.column_count].map(|n| n as usize);
        let all: Vec<_> = copies(params, &slices).collect();
        for (i, copy, to, is_new) in all {
            for (column, width) in planes(features, columns) {
                for k in 0..width {
                    let source = column * n + width * i + k;
                    let target = column * new_n + width * to + k;
                    let kept = |moments: &[f32]| if is_new { 0.0 } else { moments[source] };
                    slices.new_parameters[target] = slices.parameters[source];
                    slices.new_first_moments[target] = kept(slices.first_moments);
                    slices.new_second_moments[target] = kept(slices.second_moments);
                }
            }
            if !is_new {
                continue;
            }
            let mean = draw_mean(params, slices.parameters, i, copy);
            let [means, log_scales] = drawn(new_n);
            for k in 0..3 {
                slices.new_parameters[means + 3 * to + k] = mean[k];
                if slices.fates[i] == FATE_SPLIT {
                    slices.new_parameters[log_scales + 3 * to + k] -= 1.6f32.ln();
                }
            }
        }
    }

    /// Drawn positions are off by a cosine's error, which scales and the radius of the draw, 5.8 at most, magnify; what
    /// else there is is copied.
    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let (n, new_n) = (params.gaussian_count as usize, params.new_gaussian_count as usize);
        let mut bounds = vec![0.0; slices.new_parameters.len()];
        for (i, _, to, _) in copies(params, &slices).filter(|&(.., is_new)| is_new) {
            let ([means, log_scales], [new_means, new_log_scales]) = (drawn(n), drawn(new_n));
            let log_scales = &slices.parameters[log_scales + 3 * i..][..3];
            let scale: f64 = log_scales.iter().map(|&log| f64::from(log).exp()).sum();
            for k in 0..3 {
                let mean = f64::from(slices.parameters[means + 3 * i + k].abs());
                let roundings = (64.0 + 8.0 * f64::from(log_scales[k].abs())) * UNIT;
                bounds[new_means + 3 * to + k] =
                    5.8 * scale * (TRIGONOMETRIC + roundings) + 2.0 * UNIT * mean;
                bounds[new_log_scales + 3 * to + k] =
                    4.0 * UNIT * f64::from(log_scales[k].abs() + 1.0);
            }
        }
        Tolerances { new_parameters: Tolerance::Each(bounds), ..Tolerances::default() }
    }
}
