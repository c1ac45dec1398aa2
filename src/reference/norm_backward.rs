use nightsplat_photographs::tone::Real;

use super::norm::{affine, backward, plane};
use super::rounding::{Rounded, bounded_reference};
use crate::kernels::norm_backward::{Constants, Kernel, Params, Slices, Tolerances};

/// The gradient of every value of every channel.
pub(super) fn d_source(params: &Params, _: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 1] {
    let &Params { pixel_count, channel_count, offset, slot } = params;
    let channel = |channel| {
        let affine = affine(slices.values, offset, channel_count, channel);
        let statistics = slices.statistics[slot as usize + channel].into();
        let sums = slices.sums[channel].to_array().map(Rounded::exact);
        let means = sums.map(|sum| sum / Rounded::from_f64(pixel_count.into()));
        let [z, d] =
            [slices.source, slices.d_target].map(|image| plane(image, pixel_count, channel));
        backward(statistics, affine, means, &z, &d)
    };
    [(0..channel_count as usize).flat_map(channel).collect()]
}

bounded_reference!(d_source: d_source);
