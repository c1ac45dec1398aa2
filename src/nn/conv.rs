//! A 3x3 convolution: its kernels, forward and backward.

use glam::UVec2;

use super::conv_shape;
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{conv3x3, conv3x3_weight_gradient, reduce_strips};

/// The most output channels that one subgroup takes.
const OUT_BLOCK: u32 = 8;

/// Rows whose pixels make one partial sum of the gradient of the weights.
const STRIP_ROWS: u32 = 16;

/// What follows the sum of a convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Activation {
    None = 0,
    Relu = 1,
    Sigmoid = 2,
}

/// A convolution's kernels; its weights lie at an offset of the network's parameters.
#[derive(Debug)]
pub(super) struct Conv {
    inputs: u32,
    outputs: u32,
    shape: [u32; 2],
    subgroup_size: u32,
    forward: Pipeline<conv3x3::Kernel>,
    data_gradient: Pipeline<conv3x3::Kernel>,
    weight_gradient: Pipeline<conv3x3_weight_gradient::Kernel>,
    reduce: Pipeline<reduce_strips::Kernel>,
}

/// The input of a convolution and the gradient of its output before the activation.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seen<'a> {
    pub(super) source: &'a Buffer<f32>,
    pub(super) d_target: &'a Buffer<f32>,
}

impl Conv {
    /// Where `adds`, the gradient of the input is added to what its buffer holds.
    ///
    /// # Errors
    /// The driver refuses a kernel.
    pub(super) fn new(
        gpu: &Gpu,
        [inputs, outputs]: [u32; 2],
        activation: Activation,
        adds: bool,
    ) -> Result<Self> {
        let [columns, rows] = conv_shape(gpu);
        let forward = conv3x3::Constants {
            columns,
            rows,
            out_block: outputs.min(OUT_BLOCK),
            activation: activation as u32,
            transposed: false,
            accumulate: false,
        };
        let backward = conv3x3::Constants {
            out_block: inputs.min(OUT_BLOCK),
            activation: Activation::None as u32,
            transposed: true,
            accumulate: adds,
            ..forward
        };
        let weights = conv3x3_weight_gradient::Constants {
            rows: STRIP_ROWS,
            out_block: outputs.min(OUT_BLOCK),
        };
        Ok(Self {
            inputs,
            outputs,
            shape: [columns, rows],
            subgroup_size: gpu.properties().subgroup_size,
            forward: gpu.pipeline(&forward)?,
            data_gradient: gpu.pipeline(&backward)?,
            weight_gradient: gpu.pipeline(&weights)?,
            reduce: gpu.pipeline(&reduce_strips::Constants::default())?,
        })
    }

    /// Writes the activated convolution of `source` (in, H, W) to `target` (out, H, W).
    pub(super) fn forward(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        offset: u32,
        values: &Buffer<f32>,
        source: &Buffer<f32>,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        let (in_channels, out_channels) = (self.inputs, self.outputs);
        pass.dispatch(
            &self.forward,
            &conv3x3::Params { size, in_channels, out_channels, offset },
            conv3x3::Buffers { values, source, target },
            self.tiles(size, out_channels),
        )
    }

    /// Writes or adds the gradient of the input, given that of the output before the activation.
    pub(super) fn data_gradient(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        offset: u32,
        values: &Buffer<f32>,
        d_target: &Buffer<f32>,
        d_source: &mut Buffer<f32>,
    ) -> Result<()> {
        let (in_channels, out_channels) = (self.outputs, self.inputs);
        pass.dispatch(
            &self.data_gradient,
            &conv3x3::Params { size, in_channels, out_channels, offset },
            conv3x3::Buffers { values, source: d_target, target: d_source },
            self.tiles(size, out_channels),
        )
    }

    /// Adds the gradients of weights and biases; `partials` holds [`partial_count`] values.
    pub(super) fn weight_gradient(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        offset: u32,
        Seen { source, d_target }: Seen<'_>,
        partials: &mut Buffer<f32>,
        gradients: &mut Buffer<f32>,
    ) -> Result<()> {
        let (in_channels, out_channels) = (self.inputs, self.outputs);
        let (strip_count, parameter_count) = (strips(size), layer_len(in_channels, out_channels));
        pass.dispatch(
            &self.weight_gradient,
            &conv3x3_weight_gradient::Params { size, in_channels, out_channels },
            conv3x3_weight_gradient::Buffers { source, d_target, partials: &mut *partials },
            Threads::Workgroups([
                in_channels,
                out_channels.div_ceil(out_channels.min(OUT_BLOCK)),
                strip_count,
            ]),
        )?;
        pass.dispatch(
            &self.reduce,
            &reduce_strips::Params { parameter_count, strip_count, offset },
            reduce_strips::Buffers { partials, gradients },
            Threads::Exactly([parameter_count, 1, 1]),
        )
    }

    /// The workgroups of `conv3x3`.
    fn tiles(&self, size: UVec2, out_channels: u32) -> Threads<'static> {
        let [columns, rows] = self.shape;
        let blocks = out_channels.div_ceil(out_channels.min(OUT_BLOCK));
        let across = size.x.div_ceil(columns * self.subgroup_size);
        Threads::Workgroups([blocks, across, size.y.div_ceil(rows)])
    }
}

/// Weights and biases of a layer.
fn layer_len(inputs: u32, outputs: u32) -> u32 {
    outputs * (9 * inputs + 1)
}

fn strips(size: UVec2) -> u32 {
    size.y.div_ceil(STRIP_ROWS)
}

/// Floats that the partial sums of a layer's gradient take.
pub(super) fn partial_count(size: UVec2, [inputs, outputs]: [u32; 2]) -> usize {
    strips(size) as usize * layer_len(inputs, outputs) as usize
}
