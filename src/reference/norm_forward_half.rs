//! `norm_forward` of packed maps, unpacked and packed again.

use super::norm_forward;
use super::packed::{PackedOutput, unpacked};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::norm_forward as planes;
use crate::kernels::norm_forward_half::{Constants, Kernel, Params, Slices, Tolerances};

/// f', packed.
fn target(params: &Params, constants: &Constants, slices: &Slices<'_>) -> PackedOutput {
    let bound = bound(params, slices);
    let &Params { size, channel_count, offset, slot, .. } = params;
    let source = unpacked(size, channel_count, slices.source, slices.source_bound[0]);
    let shortcut = unpacked(size, channel_count, slices.shortcut, slices.shortcut_bound[0]);
    let pixel_count = size.element_product();
    let params = planes::Params { pixel_count, channel_count, offset, slot };
    let constants = planes::Constants { chunk: constants.chunk };
    let slices = planes::Slices {
        values: slices.values,
        statistics: slices.statistics,
        source: &source,
        shortcut: &shortcut,
        target: &mut [],
    };
    let [planes] = norm_forward::target(&params, &constants, &slices);
    PackedOutput { size, channels: channel_count, planes, bound, pixels_alone: false }
}

/// The bound of f', with the operations of the kernel.
fn bound(params: &Params, slices: &Slices<'_>) -> u32 {
    let channels = params.channel_count as usize;
    let (gamma, beta) = slices.values[params.offset as usize..][..2 * channels].split_at(channels);
    let added = |(gamma, beta): (&f32, &f32)| gamma.abs() * params.most_normalised + beta.abs();
    let most_added = gamma.iter().zip(beta).map(added).fold(0.0, f32::max);
    (f32::from_bits(slices.shortcut_bound[0]) + most_added).to_bits()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let written = target(params, constants, &slices);
        slices.target_bound[0] = written.bound;
        written.write(slices.target);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let target = target(params, constants, &slices).tolerance(slices.target.len());
        Tolerances { target_bound: Tolerance::Exact, target }
    }
}
