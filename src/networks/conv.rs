//! A 3x3 convolution in single precision: its kernels, forward and backward.

use glam::UVec2;
use serde::{Deserialize, Serialize};

use super::{conv_shape, side_by_side};
use crate::gpu::{Buffer, CooperativeMatrix, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{conv3x3, conv3x3_weight_gradient, reduce_strips};
use crate::{Error, Result};

/// The most output channels per subgroup.
const OUT_BLOCK: u32 = 8;

/// Rows of one partial sum of the weight gradient.
const STRIP_ROWS: u32 = 16;
/// With matrices, a subgroup has more channels and fewer rows, for the same number of subgroups.
pub(super) const HALF_STRIP_ROWS: u32 = 4;

/// The activation of a convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum Activation {
    None = 0,
    Relu = conv3x3::RELU,
    Sigmoid = conv3x3::SIGMOID,
}

/// The buffer that a convolution adds to instead of overwriting it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum AccumulateInto {
    Nothing,
    /// Its output.
    Output,
    /// The gradient of its input.
    InputGradient,
}

/// The precision of the factors of a convolution; sums are in single precision.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 32 bits.
    #[default]
    Single,
    /// 16 bits, by cooperative matrices if the device supports them, else as `Single`.
    Half,
}

impl Precision {
    /// The precision that the device supports.
    pub(super) fn on(self, gpu: &Gpu) -> Self {
        if self.matrix(gpu).is_some() { Self::Half } else { Self::Single }
    }

    /// The matrix shape of the factors; `None` for 32 bits.
    pub(super) fn matrix(self, gpu: &Gpu) -> Option<CooperativeMatrix> {
        gpu.properties().cooperative_matrix.filter(|_| self == Self::Half)
    }
}

impl std::str::FromStr for Precision {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match name {
            "single" => Ok(Self::Single),
            "half" => Ok(Self::Half),
            _ => Err(Error::Usage(format!("unknown precision `{name}`; single or half"))),
        }
    }
}

/// A convolution's kernels; its weights are at an offset of the network's parameters.
#[derive(Debug)]
pub(super) struct Conv {
    inputs: u32,
    outputs: u32,
    forward: Product,
    data_gradient: Product,
    weight_gradient: Pipeline<conv3x3_weight_gradient::Kernel>,
    /// Subgroups of a workgroup of the weight gradient.
    subgroups: u32,
    reduce: Reduce,
}

/// A layer: the parameters of its network, and the offset of its weights and biases.
#[derive(Clone, Copy, Debug)]
pub(super) struct Layer<'a> {
    pub(super) offset: u32,
    pub(super) values: &'a Buffer<f32>,
}

/// The images of a layer's backward pass, each (C, H, W).
#[derive(Debug)]
pub(super) struct Backward<'a> {
    /// The input of the layer.
    pub(super) source: &'a Buffer<f32>,
    /// The gradient of its output, before the activation of a convolution.
    pub(super) d_target: &'a Buffer<f32>,
    /// The gradient of its input.
    pub(super) d_source: &'a mut Buffer<f32>,
}

impl Conv {
    /// Builds the kernels. A buffer that is accumulated into keeps its content in the sum.
    pub(super) fn new(
        gpu: &Gpu,
        [inputs, outputs]: [u32; 2],
        activation: Activation,
        adds: AccumulateInto,
    ) -> Result<Self> {
        let none = Activation::None;
        let accumulate = adds == AccumulateInto::Output;
        let forward = ConvVariant { activation, transposed: false, accumulate };
        let accumulate = adds == AccumulateInto::InputGradient;
        let backward = ConvVariant { activation: none, transposed: true, accumulate };
        let subgroups = side_by_side(gpu, inputs);
        Ok(Self {
            inputs,
            outputs,
            forward: Product::new(gpu, outputs, forward)?,
            data_gradient: Product::new(gpu, inputs, backward)?,
            weight_gradient: gpu.pipeline(&conv3x3_weight_gradient::Constants {
                rows: STRIP_ROWS,
                out_block: outputs.min(OUT_BLOCK),
                subgroups,
            })?,
            subgroups,
            reduce: Reduce::new(gpu)?,
        })
    }

    /// Writes the activated convolution of `source` (in, H, W) to `target` (out, H, W), or adds it.
    pub(super) fn forward(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        layer: Layer<'_>,
        source: &Buffer<f32>,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        self.forward.record(pass, size, [self.inputs, self.outputs], layer, source, target)
    }

    /// Adds the gradients of weights and biases, and writes or adds that of the input.
    pub(super) fn backward(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        layer: Layer<'_>,
        images: Backward<'_>,
        strips: &mut Strips<'_>,
    ) -> Result<()> {
        let Backward { source, d_target, d_source } = images;
        let (inputs, outputs) = (self.inputs, self.outputs);
        let strip_count = size.y.div_ceil(STRIP_ROWS);
        pass.dispatch(
            &self.weight_gradient,
            &conv3x3_weight_gradient::Params { size, in_channels: inputs, out_channels: outputs },
            conv3x3_weight_gradient::Buffers {
                source: source.slice(),
                d_target: d_target.slice(),
                partials: strips.partials.slice_mut(),
            },
            Threads::Workgroups([
                inputs.div_ceil(self.subgroups),
                outputs.div_ceil(outputs.min(OUT_BLOCK)),
                strip_count,
            ]),
        )?;
        let parameter_count = layer_len(inputs, outputs);
        self.reduce.record(pass, parameter_count, strip_count, layer.offset, strips)?;
        self.data_gradient.record(pass, size, [outputs, inputs], layer, d_target, d_source)
    }
}

/// The variant of the kernel.
#[derive(Clone, Copy, Debug)]
pub(super) struct ConvVariant {
    pub(super) activation: Activation,
    pub(super) transposed: bool,
    pub(super) accumulate: bool,
}

/// The convolution kernel, the pixels of a workgroup, and its channels.
#[derive(Debug)]
pub(super) struct Product {
    kernel: Pipeline<conv3x3::Kernel>,
    columns: u32,
    rows: u32,
    channels: u32,
}

impl Product {
    pub(super) fn new(gpu: &Gpu, outputs: u32, variant: ConvVariant) -> Result<Self> {
        let ConvVariant { activation, transposed, accumulate } = variant;
        let [columns, rows] = conv_shape(gpu);
        let out_block = outputs.min(OUT_BLOCK);
        let subgroups = side_by_side(gpu, outputs.div_ceil(out_block));
        let kernel = gpu.pipeline(&conv3x3::Constants {
            columns,
            rows,
            out_block,
            activation: activation as u32,
            transposed,
            accumulate,
            subgroups,
        })?;
        let columns = columns * gpu.properties().subgroup_size;
        Ok(Self { kernel, columns, rows, channels: out_block * subgroups })
    }

    pub(super) fn record(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        [in_channels, out_channels]: [u32; 2],
        Layer { offset, values }: Layer<'_>,
        source: &Buffer<f32>,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        pass.dispatch(
            &self.kernel,
            &conv3x3::Params { size, in_channels, out_channels, offset },
            conv3x3::Buffers {
                values: values.slice(),
                source: source.slice(),
                target: target.slice_mut(),
            },
            Threads::Workgroups([
                out_channels.div_ceil(self.channels),
                size.x.div_ceil(self.columns),
                size.y.div_ceil(self.rows),
            ]),
        )
    }
}

/// The partial sums of a layer's gradient, and the offset that they are added to.
#[derive(Debug)]
pub(super) struct Strips<'a> {
    /// Holds [`partial_count`] values.
    pub(super) partials: &'a mut Buffer<f32>,
    pub(super) gradients: &'a mut Buffer<f32>,
}

/// The kernel that sums the strips.
#[derive(Debug)]
pub(super) struct Reduce(Pipeline<reduce_strips::Kernel>);

impl Reduce {
    pub(super) fn new(gpu: &Gpu) -> Result<Self> {
        Ok(Self(gpu.pipeline(&reduce_strips::Constants::default())?))
    }

    pub(super) fn record(
        &self,
        pass: &mut Recorder<'_>,
        parameter_count: u32,
        strip_count: u32,
        offset: u32,
        Strips { partials, gradients }: &mut Strips<'_>,
    ) -> Result<()> {
        pass.dispatch(
            &self.0,
            &reduce_strips::Params { parameter_count, strip_count, offset },
            reduce_strips::Buffers { partials: partials.slice(), gradients: gradients.slice_mut() },
            Threads::Exactly([parameter_count, 1, 1]),
        )
    }
}

/// The number of weights and biases of a layer.
fn layer_len(inputs: u32, outputs: u32) -> u32 {
    outputs * (9 * inputs + 1)
}

/// The most floats of the partial sums of a layer's gradient.
pub(super) fn partial_count(
    size: UVec2,
    [inputs, outputs]: [u32; 2],
    precision: Precision,
) -> usize {
    let rows = match precision {
        Precision::Single => STRIP_ROWS,
        Precision::Half => HALF_STRIP_ROWS,
    };
    let strips = size.y.div_ceil(rows);
    strips as usize * outputs as usize * (9 * inputs as usize + 1)
}
