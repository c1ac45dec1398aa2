//! The convolution of `conv3x3` without an activation, in double precision.

use crate::gpu::Reference;
use crate::kernels::conv3x3;
use crate::kernels::conv3x3_half::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, Slices { values, source, target }: Slices<'_>) {
        let Params { size, in_channels, out_channels, offset } = *params;
        let Constants { transposed, accumulate, .. } = *constants;
        conv3x3::Kernel::run(
            &conv3x3::Params { size, in_channels, out_channels, offset },
            &conv3x3::Constants { transposed, accumulate, ..Default::default() },
            conv3x3::Slices { values, source, target },
        );
    }
}
