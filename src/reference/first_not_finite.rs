use crate::gpu::Reference;
use crate::kernels::first_not_finite::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { values, first }: Slices<'_>) {
        let values = values.iter().take(params.value_count as usize);
        let found = values.enumerate().find(|(_, value)| !value.is_finite());
        first[0] = found.map_or(first[0], |(at, _)| first[0].min(at as u32));
    }
}
