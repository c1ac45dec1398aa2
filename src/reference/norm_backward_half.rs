//! `norm_backward` of packed maps, unpacked and packed again.

use super::norm_backward;
use super::packed::{self, unpacked};
use super::rounding::Rounded;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::norm_backward as planes;
use crate::kernels::norm_backward_half::{Constants, Kernel, Params, Slices, Tolerances};

/// dL/dz as planes.
fn d_source(params: &Params, constants: &Constants, slices: &Slices<'_>) -> Vec<Rounded> {
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
    let [d_source] = norm_backward::d_source(&params, &constants, &slices);
    d_source
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
    (of_means * f32::from_bits(slices.largest[0])).to_bits()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let (bound, d_source) = (bound(params, &slices), d_source(params, constants, &slices));
        let d_source: Vec<f64> = d_source.into_iter().map(|it| it.value).collect();
        slices.d_source_bound[0] = bound;
        packed::write(params.size, params.channel_count, &d_source, bound, false, slices.d_source);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let (bound, d_source) = (bound(params, &slices), d_source(params, constants, &slices));
        let (size, channels) = (params.size, params.channel_count);
        let words = 4 * slices.d_source.len();
        Tolerances {
            d_source_bound: Tolerance::Exact,
            d_source: packed::tolerance(size, channels, &d_source, bound, words),
        }
    }
}
