//! The children of a densified Gaussian.

use std::f32::consts::TAU;

use glam::{Quat, Vec3};
use nightsplat_models::attributes::Attribute;

use super::gaussian::{Words, sigmoid};
use super::random::random_bits;
use super::rounding::{TRIGONOMETRIC, UNIT};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::densify_action::{
    ACTION_CLONE, ACTION_KEEP, ACTION_SPLIT, PAPER_LOG_SPLIT_FACTOR, SPLIT_ACROSS,
    SPLIT_ACROSS_SLOPE, SPLIT_ALONG, SPLIT_ALONG_SLOPE, SPLIT_OFFSET, SPLIT_OPACITY,
    SPLIT_OPACITY_SLOPE,
};
use crate::kernels::densify_scatter::{Constants, Kernel, Params, Slices, Tolerances};

fn random_uniform(key: u32) -> f32 {
    ((random_bits(key) >> 8) + 1) as f32 / 16_777_216.0
}

fn random_normal3(key: u32) -> Vec3 {
    let uniform = |draw: u32| random_uniform(key.wrapping_add(draw));
    let radius = [0, 1].map(|draw| (-2.0 * uniform(draw).ln()).sqrt());
    let angle = [2, 3].map(|draw| TAU * uniform(draw));
    Vec3::new(radius[0] * angle[0].cos(), radius[0] * angle[0].sin(), radius[1] * angle[1].cos())
}

/// A child of a Gaussian.
pub(super) struct Child {
    pub(super) of: usize,
    /// The first or the second.
    index: u32,
    pub(super) to: usize,
    pub(super) is_new: bool,
}

/// The children in a batch of new Gaussians, given by its offset and length, of all `count` Gaussians.
pub(super) fn copies<'a>(
    count: usize,
    actions: &'a [u32],
    offsets: &'a [u32],
    [first_new, new_count]: [u32; 2],
) -> impl Iterator<Item = Child> + use<'a> {
    (0..count).flat_map(move |of| {
        let action = actions[of];
        let count = match action {
            ACTION_CLONE | ACTION_SPLIT => 2,
            ACTION_KEEP => 1,
            _ => 0,
        };
        (0..count).filter_map(move |index| {
            let to = (offsets[of] + index).checked_sub(first_new).filter(|&to| to < new_count)?;
            Some(Child { of, index, to: to as usize, is_new: action == ACTION_SPLIT || index > 0 })
        })
    })
}

/// The attributes that density control changes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChildGaussian {
    /// World units.
    pub mean: Vec3,
    /// ln of the standard deviations, in world units.
    pub log_scales: Vec3,
    /// Before the sigmoid.
    pub raw_opacity: f32,
}

/// One half, the first or the second, of a Gaussian with this `rotation`, split along its longest axis.
pub fn half_of(parent: &ChildGaussian, rotation: Quat, copy: u32) -> ChildGaussian {
    let log_scales = parent.log_scales;
    let (axis, longest) = (log_scales.max_position(), log_scales.max_element());
    let opacity = sigmoid(f64::from(parent.raw_opacity));
    let new_opacity = opacity * (SPLIT_OPACITY + SPLIT_OPACITY_SLOPE * opacity);
    let mut factors = Vec3::splat((SPLIT_ACROSS + SPLIT_ACROSS_SLOPE * opacity) as f32);
    factors[axis] = (SPLIT_ALONG + SPLIT_ALONG_SLOPE * opacity) as f32;
    let offset = (if copy == 0 { SPLIT_OFFSET } else { -SPLIT_OFFSET }) as f32 * longest.exp();
    ChildGaussian {
        mean: parent.mean + rotation * (Vec3::AXES[axis] * offset),
        log_scales: log_scales + factors.ln(),
        raw_opacity: (new_opacity / (1.0 - new_opacity)).ln() as f32,
    }
}

/// A Gaussian whose position is drawn from the normal distribution of `parent`.
fn drawn(parent: &ChildGaussian, rotation: Quat, is_split: bool, key: u32) -> ChildGaussian {
    let shrink = if is_split { PAPER_LOG_SPLIT_FACTOR as f32 } else { 0.0 };
    ChildGaussian {
        mean: parent.mean + rotation * (parent.log_scales.exp() * random_normal3(key)),
        log_scales: parent.log_scales - shrink,
        ..*parent
    }
}

/// The offsets of the planes that density control changes, for `count` Gaussians.
fn changed(count: usize) -> [usize; 3] {
    [Attribute::Means, Attribute::LogScales, Attribute::RawOpacities]
        .map(|attribute| attribute.column(0) * count)
}

fn shape(parameters: &[f32], count: usize, i: usize) -> ChildGaussian {
    let [means, log_scales, raw_opacities] = changed(count);
    ChildGaussian {
        mean: Vec3::from_slice(&parameters[means + 3 * i..]),
        log_scales: Vec3::from_slice(&parameters[log_scales + 3 * i..]),
        raw_opacity: parameters[raw_opacities + i],
    }
}

fn rotation(parameters: &[f32], count: usize, i: usize) -> Quat {
    let quat = &parameters[Attribute::Quats.column(0) * count + 4 * i..];
    let quat = Quat::from_xyzw(quat[1], quat[2], quat[3], quat[0]);
    if quat.length() > 1e-12 { quat.normalize() } else { Quat::IDENTITY }
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let (n, new_n) = (params.gaussian_count as usize, params.new_gaussian_count as usize);
        let widths = [params.feature_count, params.column_count];
        let words = |count| Words::new(count, widths, constants.rest_by_column);
        let step_key = random_bits(random_bits(params.seed).wrapping_add(params.step));
        let new = [params.first_new_gaussian, params.new_gaussian_count];
        for Child { of: i, index, to, is_new } in copies(n, slices.actions, slices.offsets, new) {
            for (to, from) in words(new_n).of_gaussian(to).zip(words(n).of_gaussian(i)) {
                slices.new_parameters[to] = slices.parameters[from];
            }
            if !is_new {
                continue;
            }
            let parent = shape(slices.parameters, n, i);
            let rotation = rotation(slices.parameters, n, i);
            let child = if constants.conserving {
                half_of(&parent, rotation, index)
            } else {
                let draw = 2 * (params.first_gaussian + i as u32) + index;
                let key = random_bits(step_key.wrapping_add(draw));
                drawn(&parent, rotation, slices.actions[i] == ACTION_SPLIT, key)
            };
            let [means, log_scales, raw_opacities] = changed(new_n);
            for k in 0..3 {
                slices.new_parameters[means + 3 * to + k] = child.mean[k];
                slices.new_parameters[log_scales + 3 * to + k] = child.log_scales[k];
            }
            slices.new_parameters[raw_opacities + to] = child.raw_opacity;
        }
    }

    /// Drawn positions have the error of a cosine, magnified by scales and the radius of the draw, at most 5.8;
    /// positions of a half have the errors of an exponential and of the axes, its opacity that of the logarithm of a
    /// quotient. Everything else is copied.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let (n, new_n) = (params.gaussian_count as usize, params.new_gaussian_count as usize);
        let mut bounds = vec![0.0; slices.new_parameters.len()];
        let new = [params.first_new_gaussian, params.new_gaussian_count];
        let copies = copies(n, slices.actions, slices.offsets, new);
        for Child { of: i, to, .. } in copies.filter(|copy| copy.is_new) {
            let parent = shape(slices.parameters, n, i);
            let [means, log_scales, raw_opacities] = changed(new_n);
            let scale: f64 =
                parent.log_scales.to_array().map(|log| f64::from(log).exp()).iter().sum();
            for k in 0..3 {
                let log_scale = f64::from(parent.log_scales[k].abs());
                let roundings = (64.0 + 8.0 * log_scale) * UNIT;
                bounds[means + 3 * to + k] = 5.8 * scale * (TRIGONOMETRIC + roundings)
                    + 2.0 * UNIT * f64::from(parent.mean[k].abs());
                bounds[log_scales + 3 * to + k] = 16.0 * UNIT * (log_scale + 1.0);
            }
            if constants.conserving {
                let raw_opacity = f64::from(parent.raw_opacity.abs());
                bounds[raw_opacities + to] = 64.0 * UNIT * (raw_opacity + 1.0);
            }
        }
        Tolerances { new_parameters: Tolerance::Each(bounds) }
    }
}
