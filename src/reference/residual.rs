//! The end of a denoiser stage in double precision.

use crate::gpu::Reference;
use crate::kernels::residual::{Constants, Kernel, Params, Slices};

/// clamp(`R_0` - (I + u), 0, 1).
pub fn residual(render: f64, stage_input: f64, update: f64) -> f64 {
    (render - (stage_input + update)).clamp(0.0, 1.0)
}

impl Reference for Kernel {
    /// In single precision, like the kernel: the gradient of the clamp depends on the bits.
    fn run(
        params: &Params,
        constants: &Constants,
        Slices { render, stage_input, update, denoised }: Slices<'_>,
    ) {
        for i in 0..params.value_count as usize {
            denoised[i] = if constants.identity {
                stage_input[i] - update[i]
            } else {
                (render[i] - (stage_input[i] + update[i])).clamp(0.0, 1.0)
            };
        }
    }
}
