//! The repeated convolution of a denoiser stage, in single precision or by 16-bit matrices.

use glam::UVec2;

use super::conv::{AccumulateInto, Activation, Backward, Conv, Layer, Precision, Strips};
use super::half::{Direction, HalfConv, PackedMap, PackedWeights};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Recorder};

/// Its kernels, with the packed weights of every layer.
#[derive(Debug)]
pub(super) enum Inner {
    Single(Conv),
    Half { conv: HalfConv, layers: Vec<PackedWeights> },
}

/// A layer and its number.
#[derive(Clone, Copy, Debug)]
pub(super) struct InnerLayer<'a> {
    pub(super) number: usize,
    pub(super) layer: Layer<'a>,
}

/// The packed forms of a layer's input, as its forward pass left it, and of the gradient of its output.
#[derive(Debug)]
pub(super) struct PackedBackward<'a> {
    pub(super) source: &'a PackedMap,
    pub(super) d_target: &'a mut PackedMap,
}

impl Inner {
    pub(super) fn new(
        gpu: &Gpu,
        channels: u32,
        layers: u32,
        adds: AccumulateInto,
        precision: Precision,
    ) -> Result<Self> {
        let Some(matrix) = precision.matrix(gpu) else {
            return Ok(Self::Single(Conv::new(gpu, [channels; 2], Activation::None, adds)?));
        };
        let conv = HalfConv::new(gpu, channels, matrix, adds)?;
        let layers = (0..layers).map(|_| conv.packed_weights(gpu)).collect::<Result<_>>()?;
        Ok(Self::Half { conv, layers })
    }

    /// Packs the weights of a layer for a direction, once per step; for the backward direction after the forward one.
    pub(super) fn prepare(
        &mut self,
        pass: &mut Recorder<'_>,
        way: Direction,
        InnerLayer { number, layer }: InnerLayer<'_>,
    ) -> Result<()> {
        match self {
            Self::Single(_) => Ok(()),
            Self::Half { conv, layers } => conv.pack_weights(pass, way, layer, &mut layers[number]),
        }
    }

    /// Writes the convolution of `source` (C, H, W) to `target`, and leaves `source` packed.
    pub(super) fn forward(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        InnerLayer { number, layer }: InnerLayer<'_>,
        source: &Buffer<f32>,
        packed: &mut PackedMap,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        match self {
            Self::Single(conv) => conv.forward(pass, size, layer, source, target),
            Self::Half { conv, layers } => {
                conv.pack_map(pass, size, source, packed)?;
                let (way, weights) = (Direction::Forward, &layers[number]);
                conv.product(pass, size, way, layer, weights, packed, target)
            }
        }
    }

    /// Adds the gradients of weights and biases, and writes or adds that of the input.
    pub(super) fn backward(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        InnerLayer { number, layer }: InnerLayer<'_>,
        images: Backward<'_>,
        packed: PackedBackward<'_>,
        strips: &mut Strips<'_>,
    ) -> Result<()> {
        match self {
            Self::Single(conv) => conv.backward(pass, size, layer, images, strips),
            Self::Half { conv, layers } => {
                let PackedBackward { source, d_target } = packed;
                conv.pack_map(pass, size, images.d_target, d_target)?;
                let (offset, factors) = (layer.offset, [source, &*d_target]);
                conv.weight_gradient(pass, size, offset, factors, images.d_target, strips)?;
                let (way, weights) = (Direction::Backward, &layers[number]);
                conv.product(pass, size, way, layer, weights, d_target, images.d_source)
            }
        }
    }
}
