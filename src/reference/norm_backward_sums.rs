use super::norm::{affine, backward_terms, plane};
use super::rounding::{Rounded, bounded_reference, chain};
use crate::kernels::norm_backward_sums::{Constants, Kernel, Params, Slices, Tolerances};

/// Both sums of every chunk of every channel.
pub(super) fn partials(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
) -> [Vec<Rounded>; 1] {
    let &Params { pixel_count, channel_count, offset, slot } = params;
    let chunk = constants.chunk as usize;
    let channel = |channel| {
        let affine = affine(slices.values, offset, channel_count, channel);
        let statistics = slices.statistics[slot as usize + channel].into();
        let [z, d] =
            [slices.source, slices.d_target].map(|image| plane(image, pixel_count, channel));
        let sums = z.chunks(chunk).zip(d.chunks(chunk)).flat_map(|(z, d)| {
            let terms: Vec<_> = backward_terms(statistics, affine, z, d).collect();
            [0, 1].map(|which| Rounded::sum(chain(chunk), terms.iter().map(|of| of[which])))
        });
        sums.collect::<Vec<_>>()
    };
    [(0..channel_count as usize).flat_map(channel).collect()]
}

bounded_reference!(partials: partials);
