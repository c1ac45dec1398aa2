use crate::gpu::Reference;
use crate::kernels::tone_map::{Constants, Kernel, Params, Slices};
use crate::tone::tone_curve;

impl Reference for Kernel {
    fn run(
        params: &Params,
        constants: &Constants,
        Slices { image, parameters, target }: Slices<'_>,
    ) {
        for i in 0..params.value_count as usize {
            target[i] =
                tone_curve(constants.tone_curve, image[i], &parameters[params.view as usize]);
        }
    }
}
