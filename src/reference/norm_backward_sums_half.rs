//! `norm_backward_sums` of packed maps, unpacked; and the largest magnitude of the gradient, as bits.

use super::norm_backward_sums::partials;
use super::packed::unpacked;
use super::rounding::{Rounded, write};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::norm_backward_sums;
use crate::kernels::norm_backward_sums_half::{Constants, Kernel, Params, Slices, Tolerances};

/// dL/df' as planes, and both sums of every chunk of every channel.
fn sums(params: &Params, constants: &Constants, slices: &Slices<'_>) -> (Vec<f32>, Vec<Rounded>) {
    let &Params { size, channel_count, offset, slot, .. } = params;
    let source = unpacked(size, channel_count, slices.source, slices.source_bound[0]);
    let d_target = unpacked(size, channel_count, slices.d_target, slices.d_target_bound[0]);
    let pixel_count = size.element_product();
    let params = norm_backward_sums::Params { pixel_count, channel_count, offset, slot };
    let constants = norm_backward_sums::Constants { chunk: constants.chunk };
    let slices = norm_backward_sums::Slices {
        values: slices.values,
        statistics: slices.statistics,
        source: &source,
        d_target: &d_target,
        partials: &mut [],
    };
    let [sums] = partials(&params, &constants, &slices);
    (d_target, sums)
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let (d_target, sums) = sums(params, constants, &slices);
        write(sums, slices.partials);
        let largest = &mut slices.largest[(params.slot / params.channel_count) as usize];
        *largest = d_target.iter().map(|d| d.abs().to_bits()).fold(*largest, u32::max);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let (_, sums) = sums(params, constants, &slices);
        Tolerances { partials: sums.into_iter().collect(), largest: Tolerance::Exact }
    }
}
