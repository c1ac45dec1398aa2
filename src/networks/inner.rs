//! The repeated convolution of a denoiser stage, in single precision or by 16-bit matrices.

use glam::UVec2;

use super::conv::{AccumulateInto, Activation, Conv, Precision, Strips, WeightGradientInputs};
use super::half::{Direction, HalfConv, PackedMap, PackedWeights};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Recorder};

/// Its kernels, with the packed weights of every layer.
#[derive(Debug)]
pub(super) enum Inner {
    Single(Conv),
    Half { conv: HalfConv, layers: Vec<PackedWeights> },
}

/// A layer: its number, and its offset in the values.
#[derive(Clone, Copy, Debug)]
pub(super) struct InnerLayer<'a> {
    pub(super) number: usize,
    pub(super) offset: u32,
    pub(super) values: &'a Buffer<f32>,
}

/// A map, and its packed form.
#[derive(Debug)]
pub(super) struct Map<'a> {
    pub(super) single: &'a Buffer<f32>,
    pub(super) packed: &'a mut PackedMap,
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
        layer: InnerLayer<'_>,
    ) -> Result<()> {
        let InnerLayer { number, offset, values } = layer;
        match self {
            Self::Single(_) => Ok(()),
            Self::Half { conv, layers } => {
                conv.pack_weights(pass, way, offset, values, &mut layers[number])
            }
        }
    }

    /// Writes the convolution of `source` (C, H, W) to `target`, and leaves `source` packed.
    pub(super) fn forward(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        layer: InnerLayer<'_>,
        source: Map<'_>,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        let (InnerLayer { number, offset, values }, Map { single, packed }) = (layer, source);
        match self {
            Self::Single(conv) => conv.forward(pass, size, offset, values, single, target),
            Self::Half { conv, layers } => {
                conv.pack_map(pass, size, single, packed)?;
                let (own, weights) = ((offset, values), &layers[number]);
                conv.product(pass, size, Direction::Forward, own, weights, packed, target)
            }
        }
    }

    /// Adds the gradients of weights and biases, and writes or adds that of the input, `d_source`, from that of the
    /// output, `d_target`. The input must be that of the forward pass, in single precision, and packed as the forward
    /// pass left it.
    #[expect(clippy::too_many_arguments, reason = "a layer, its place, two maps and two gradients")]
    pub(super) fn backward(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        layer: InnerLayer<'_>,
        source: (&Buffer<f32>, &PackedMap),
        d_target: Map<'_>,
        d_source: &mut Buffer<f32>,
        strips: Strips<'_>,
    ) -> Result<()> {
        let (InnerLayer { number, offset, values }, Map { single, packed }) = (layer, d_target);
        match self {
            Self::Single(conv) => {
                let seen = WeightGradientInputs { source: source.0, d_target: single };
                let Strips { partials, gradients } = strips;
                conv.weight_gradient(pass, size, offset, seen, partials, gradients)?;
                conv.data_gradient(pass, size, offset, values, single, d_source)
            }
            Self::Half { conv, layers } => {
                conv.pack_map(pass, size, single, packed)?;
                let factors = [source.1, &*packed];
                conv.weight_gradient(pass, size, offset, factors, single, strips)?;
                let (own, weights) = ((offset, values), &layers[number]);
                conv.product(pass, size, Direction::Backward, own, weights, packed, d_source)
            }
        }
    }
}
