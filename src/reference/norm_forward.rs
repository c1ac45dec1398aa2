use super::norm::{affine, forward, plane};
use super::rounding::{Rounded, bounded_reference};
use crate::kernels::norm_forward::{Constants, Kernel, Params, Slices, Tolerances};

/// Every value of every channel.
pub(super) fn target(params: &Params, _: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 1] {
    let &Params { pixel_count, channel_count, offset, slot } = params;
    let channel = |channel| {
        let affine = affine(slices.values, offset, channel_count, channel);
        let statistics = slices.statistics[slot as usize + channel].into();
        let added = forward(statistics, affine, &plane(slices.source, pixel_count, channel));
        let shortcut = plane(slices.shortcut, pixel_count, channel);
        shortcut.into_iter().zip(added).map(|(shortcut, added)| shortcut + added)
    };
    [(0..channel_count as usize).flat_map(channel).collect()]
}

bounded_reference!(target: target);
