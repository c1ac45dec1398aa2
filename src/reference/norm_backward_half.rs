//! `norm_backward` of packed maps, unpacked and packed again.

use super::norm_backward;
use super::packed::{PackedOutput, unpacked};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::norm_backward as planes;
use crate::kernels::norm_backward_half::{Constants, Kernel, Params, Slices, Tolerances};

/// dL/dz, packed.
fn d_source(params: &Params, constants: &Constants, slices: &Slices<'_>) -> PackedOutput {
    let bound = bound(params, slices);
    let &Params { size, channel_count, offset, slot, .. } = params;
    let source = unpacked(size, channel_count, slices.source, slices.source_bound[0]);
    let d_target = unpacked(size, channel_count, slices.d_target, slices.d_target_bound[0]);
    let pixel_count = size.element_product();
    let params = planes::Params { pixel_count, channel_count, offset, slot };
    let constants = planes::Constants { chunk: constants.chunk };
    let slices = planes::Slices {
        values: slices.values,
        statistics: slices.statistics,
        sums: slices.sums,
        source: &source,
        d_target: &d_target,
        d_source: &mut [],
    };
    let [planes] = norm_backward::d_source(&params, &constants, &slices);
    PackedOutput { size, channels: channel_count, planes, bound, pixels_alone: false }
}

/// The bound of dL/dz, with the operations of the kernel.
fn bound(params: &Params, slices: &Slices<'_>) -> u32 {
    let factor = |channel: usize| {
        let gamma = slices.values[params.offset as usize + channel];
        let deviation = slices.statistics[params.slot as usize + channel].inverse_deviation;
        (gamma * deviation).abs()
    };
    let largest_factor = (0..params.channel_count as usize).map(factor).fold(0.0, f32::max);
    let of_means = largest_factor * (2.0 + params.most_normalised);
    (of_means * f32::from_bits(slices.largest[(params.slot / params.channel_count) as usize]))
        .to_bits()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let written = d_source(params, constants, &slices);
        slices.d_source_bound[0] = written.bound;
        written.write(slices.d_source);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let d_source = d_source(params, constants, &slices).tolerance(slices.d_source.len());
        Tolerances { d_source_bound: Tolerance::Exact, d_source }
    }
}
