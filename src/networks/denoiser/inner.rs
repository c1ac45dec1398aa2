//! The repeats of a denoiser stage, f = f + relu(norm(conv(f))), in single precision or on packed maps with 16-bit
//! matrices. A norm removes the bias of the convolution before it: on packed maps it is left out, with its gradient,
//! which is zero.

use glam::UVec2;

use super::super::conv::{AccumulateInto, Activation, Backward, Conv, Layer, Precision, Strips};
use super::super::half::{Direction, HalfConv, PackedWeights, ShortcutMap};
use super::super::norm::{Forward, Norm, NormUse};
use super::super::norm_half::HalfNorm;
use super::memory::{Activations, StageGradients};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Recorder};

/// Its kernels, with the packed weights of every stage.
#[derive(Debug)]
pub(super) enum Inner {
    Single { conv: Conv, norm: Norm },
    Half { conv: HalfConv, norm: HalfNorm, stages: Vec<PackedWeights> },
}

/// The layers of a stage, and its number: offsets in `values`.
#[derive(Clone, Copy, Debug)]
pub(super) struct InnerStage<'a> {
    pub(super) number: usize,
    pub(super) conv: u32,
    pub(super) norm: u32,
    pub(super) values: &'a Buffer<f32>,
}

impl InnerStage<'_> {
    fn conv(&self) -> Layer<'_> {
        Layer { offset: self.conv, values: self.values }
    }

    fn norm(&self, size: UVec2, repeat: usize) -> NormUse {
        NormUse { size, offset: self.norm, repeat: repeat as u32 }
    }
}

impl Inner {
    pub(super) fn new(gpu: &Gpu, channels: u32, stages: u32, precision: Precision) -> Result<Self> {
        let Some(matrix) = precision.matrix(gpu) else {
            let adds = AccumulateInto::InputGradient;
            let conv = Conv::new(gpu, [channels; 2], Activation::None, adds)?;
            return Ok(Self::Single { conv, norm: Norm::new(gpu, channels)? });
        };
        let conv = HalfConv::new(gpu, channels, matrix)?;
        let stages = (0..stages).map(|_| conv.packed_weights(gpu)).collect::<Result<_>>()?;
        Ok(Self::Half { conv, norm: HalfNorm::new(gpu, channels)?, stages })
    }

    /// Packs the weights of a stage for a direction, once per step; for the backward direction after the forward one.
    pub(super) fn prepare(
        &mut self,
        pass: &mut Recorder<'_>,
        way: Direction,
        stage: InnerStage<'_>,
    ) -> Result<()> {
        match self {
            Self::Single { .. } => Ok(()),
            Self::Half { conv, stages, .. } => {
                conv.pack_weights(pass, way, stage.conv(), &mut stages[stage.number])
            }
        }
    }

    /// From the first f of `maps` to the last.
    pub(super) fn forward(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        stage: InnerStage<'_>,
        maps: &mut Activations,
    ) -> Result<()> {
        let Activations { features, convolved, packed, packed_convolved, norm: memory, .. } = maps;
        match self {
            Self::Single { conv, norm } => {
                for (repeat, convolved) in convolved.iter_mut().enumerate() {
                    let (before, after) = features.split_at_mut(repeat + 1);
                    let (shortcut, target) = (&before[repeat], &mut after[0]);
                    conv.forward(pass, size, stage.conv(), shortcut, convolved)?;
                    let images = Forward { source: convolved, shortcut, target };
                    norm.forward(pass, stage.norm(size, repeat), stage.values, memory, images)?;
                }
                Ok(())
            }
            Self::Half { conv, norm, stages } => {
                conv.pack_map(pass, size, &features[0], &mut packed[0])?;
                let (way, weights) = (Direction::Forward, &stages[stage.number]);
                for (repeat, convolved) in packed_convolved.iter_mut().enumerate() {
                    let (before, after) = packed.split_at_mut(repeat + 1);
                    let (shortcut, target) = (&before[repeat], &mut after[0]);
                    conv.product(pass, size, way, weights, shortcut, None, convolved)?;
                    let of = stage.norm(size, repeat);
                    let maps = [&*convolved, shortcut];
                    norm.forward(pass, of, stage.values, memory, maps, target)?;
                }
                conv.unpack_map(pass, size, &packed[packed_convolved.len()], &mut features[1])
            }
        }
    }

    /// From the gradient of the last f to that of the first, in `features` of `gradients`; adds those of the
    /// parameters.
    pub(super) fn backward(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        stage: InnerStage<'_>,
        maps: &mut Activations,
        gradients: &mut StageGradients,
        strips: &mut Strips<'_>,
    ) -> Result<()> {
        let Activations { features, convolved, packed, packed_convolved, norm: memory, .. } = maps;
        let StageGradients { features: d_features, convolved: d_convolved, .. } = gradients;
        match self {
            Self::Single { conv, norm } => {
                for (repeat, convolved) in convolved.iter().enumerate().rev() {
                    let (d_target, d_source) = (&*d_features, &mut *d_convolved);
                    let images = Backward { source: convolved, d_target, d_source };
                    let of = stage.norm(size, repeat);
                    norm.backward(pass, of, stage.values, strips.gradients, memory, images)?;
                    // The shortcut passes the gradient through: that of the convolution is added to it.
                    let (source, d_source) = (&features[repeat], &mut *d_features);
                    let images = Backward { source, d_target: &*d_convolved, d_source };
                    conv.backward(pass, size, stage.conv(), images, strips)?;
                }
                Ok(())
            }
            Self::Half { conv, norm, stages } => {
                let [before, after, d_convolved] = &mut gradients.packed;
                let (mut d_target, mut d_source) = (before, after);
                conv.pack_map(pass, size, d_features, d_target)?;
                pass.fill(&mut memory.largest, 0);
                let (way, weights) = (Direction::Backward, &stages[stage.number]);
                for (repeat, convolved) in packed_convolved.iter().enumerate().rev() {
                    let (of, read) = (stage.norm(size, repeat), [convolved, &*d_target]);
                    let gradients = &mut *strips.gradients;
                    norm.backward(pass, of, stage.values, gradients, memory, read, d_convolved)?;
                    let factors = [&packed[repeat], &*d_convolved];
                    conv.weight_gradient(pass, size, stage.conv, factors, strips)?;
                    let (largest, index) = (&memory.largest, repeat as u32);
                    let shortcut = Some(ShortcutMap { largest, index, map: d_target });
                    conv.product(pass, size, way, weights, d_convolved, shortcut, d_source)?;
                    std::mem::swap(&mut d_target, &mut d_source);
                }
                conv.unpack_map(pass, size, d_target, d_features)
            }
        }
    }
}
