use super::norm::{affine, forward, plane};
use super::rounding::{Rounded, values};
use crate::gpu::Reference;
use crate::kernels::norm_forward::{Constants, Kernel, Params, Slices, Tolerances};

/// Every value of every channel.
fn target(params: &Params, slices: &Slices<'_>) -> Vec<Rounded> {
    let &Params { pixel_count, channel_count, offset, slot } = params;
    let channel = |channel| {
        let affine = affine(slices.values, offset, channel_count, channel);
        let statistics = slices.statistics[slot as usize + channel].into();
        let added = forward(statistics, affine, &plane(slices.source, pixel_count, channel));
        let shortcut = plane(slices.shortcut, pixel_count, channel);
        shortcut.into_iter().zip(added).map(|(shortcut, added)| shortcut + added)
    };
    (0..channel_count as usize).flat_map(channel).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let target = values(target(params, &slices));
        slices.target.iter_mut().zip(target).for_each(|(to, value)| *to = value);
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances { target: target(params, &slices).into_iter().collect() }
    }
}
