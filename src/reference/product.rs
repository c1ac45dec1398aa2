use crate::gpu::{Reference, Tolerance};
use crate::kernels::product::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { illumination, denoised, target }: Slices<'_>) {
        for i in 0..params.value_count as usize {
            target[i] = illumination[i] * denoised[i];
        }
    }

    fn tolerances(_: &Params, _: &Constants, _: Slices<'_>) -> Tolerances {
        Tolerances { target: Tolerance::Roundings(1.0) }
    }
}
