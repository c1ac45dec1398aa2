//! `norm_statistics` of a packed map, unpacked.

use super::packed::unpacked;
use crate::gpu::Reference;
use crate::kernels::norm_statistics;
use crate::kernels::norm_statistics_half::{Constants, Kernel, Params, Slices, Tolerances};

/// What the kernel for planes takes.
fn planes(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
) -> (norm_statistics::Params, norm_statistics::Constants, Vec<f32>) {
    let &Params { size, channel_count, offset, slot, .. } = params;
    let source = unpacked(size, channel_count, slices.source, slices.source_bound[0]);
    let pixel_count = size.element_product();
    let of_planes = norm_statistics::Params { pixel_count, channel_count, offset, slot };
    (of_planes, norm_statistics::Constants { chunk: constants.chunk }, source)
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let (params, constants, source) = planes(params, constants, &slices);
        let slices = norm_statistics::Slices { source: &source, partials: slices.partials };
        norm_statistics::Kernel::run(&params, &constants, slices);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let (params, constants, source) = planes(params, constants, &slices);
        let slices = norm_statistics::Slices { source: &source, partials: slices.partials };
        let of_planes = norm_statistics::Kernel::tolerances(&params, &constants, slices);
        Tolerances { partials: of_planes.partials }
    }
}
