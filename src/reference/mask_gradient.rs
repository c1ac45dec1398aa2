use crate::gpu::{Reference, Tolerance};
use crate::kernels::mask_gradient::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { weights, d_render }: Slices<'_>) {
        let pixels = params.pixel_count as usize;
        for i in 0..params.value_count as usize {
            d_render[i] *= weights[i % pixels];
        }
    }

    fn tolerances(_: &Params, _: &Constants, _: Slices<'_>) -> Tolerances {
        Tolerances { d_render: Tolerance::Roundings(1.0) }
    }
}
