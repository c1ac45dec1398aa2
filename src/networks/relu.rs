//! The gradient of a `ReLU`.

use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::relu_backward;

/// Zeroes gradients where a `ReLU` gave zero.
#[derive(Debug)]
pub(super) struct ReluBackward(Pipeline<relu_backward::Kernel>);

impl ReluBackward {
    pub(super) fn new(gpu: &Gpu) -> Result<Self> {
        Ok(Self(gpu.pipeline(&relu_backward::Constants::default())?))
    }

    /// Records it for the first `value_count` values of `activations`, the outputs of the `ReLU`, and of their
    /// gradient.
    pub(super) fn record(
        &self,
        pass: &mut Recorder<'_>,
        value_count: u32,
        activations: &Buffer<f32>,
        gradient: &mut Buffer<f32>,
    ) -> Result<()> {
        pass.dispatch(
            &self.0,
            &relu_backward::Params { value_count },
            relu_backward::Buffers {
                activations: activations.slice(),
                gradient: gradient.slice_mut(),
            },
            Threads::Exactly([value_count, 1, 1]),
        )
    }
}
