use crate::gpu::Reference;
use crate::kernels::relu_backward::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { activations, gradient }: Slices<'_>) {
        for i in 0..params.value_count as usize {
            gradient[i] = if activations[i] > 0.0 { gradient[i] } else { 0.0 };
        }
    }
}
