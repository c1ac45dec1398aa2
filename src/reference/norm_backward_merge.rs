use glam::Vec2;

use super::rounding::{Rounded, chain, write};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::norm_backward_merge::{Constants, Kernel, Params, Slices, Tolerances};

/// Both sums of every channel.
fn sums(params: &Params, constants: &Constants, partials: &[Vec2]) -> Vec<[Rounded; 2]> {
    let chunks = params.pixel_count.div_ceil(constants.chunk) as usize;
    let channel = |channel: usize| {
        let of_channel = &partials[channel * chunks..][..chunks];
        let sum = |which| of_channel.iter().map(move |partial| Rounded::exact(partial[which]));
        [0, 1].map(|which| Rounded::sum(chain(chunks), sum(which)))
    };
    (0..params.channel_count as usize).map(channel).collect()
}

/// The indices of the gradients of gamma and beta to which a channel's sums are added, with the sums.
fn added(params: &Params, channel: usize, sums: [Rounded; 2]) -> [(usize, Rounded); 2] {
    let at = params.offset as usize + channel;
    [(at, sums[1]), (at + params.channel_count as usize, sums[0])]
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let sums = sums(params, constants, slices.partials);
        write(sums.iter().flatten().copied(), slices.sums);
        for (channel, sums) in sums.into_iter().enumerate() {
            for (at, sum) in added(params, channel, sums) {
                slices.gradients[at] = (f64::from(slices.gradients[at]) + sum.value) as f32;
            }
        }
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let sums = sums(params, constants, slices.partials);
        let mut gradients = vec![0.0; slices.gradients.len()];
        for (channel, &sums) in sums.iter().enumerate() {
            for (at, sum) in added(params, channel, sums) {
                gradients[at] = (Rounded::exact(slices.gradients[at]) + sum).bound();
            }
        }
        let gradients = Tolerance::Each(gradients);
        Tolerances { sums: sums.into_iter().flatten().collect(), gradients }
    }
}
