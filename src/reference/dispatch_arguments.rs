use crate::gpu::Reference;
use crate::kernels::dispatch_arguments::{Constants, Kernel, MAX_GROUPS, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { counts, arguments }: Slices<'_>) {
        let count = counts[params.count_index as usize].min(params.capacity);
        let groups = count.div_ceil(params.items_per_workgroup);
        let rows = groups.div_ceil(MAX_GROUPS);
        arguments[0] = [if rows == 0 { 0 } else { groups.div_ceil(rows) }, rows, 1];
    }
}
