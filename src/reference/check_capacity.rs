use crate::gpu::Reference;
use crate::kernels::check_capacity::{Constants, Kernel, Params, Slices};
use crate::kernels::status::STATUS_OVERFLOWED;

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { total, counts, status }: Slices<'_>) {
        let fits = total[0] <= params.capacity;
        counts[0] = if fits { total[0] } else { 0 };
        if !fits {
            status[0] |= STATUS_OVERFLOWED;
        }
        status[1] = status[1].max(total[0]);
    }
}
