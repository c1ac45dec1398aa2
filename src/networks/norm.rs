//! Norm, `ReLU` and shortcut of a repeat: f' = f + relu(gamma (z - mean) / deviation + beta), with the statistics of
//! the image.

use glam::Vec2;

use super::conv::Backward;
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{
    ChannelStatistics, norm_backward, norm_backward_merge, norm_backward_sums, norm_forward,
    norm_merge, norm_statistics,
};

/// Values of a channel per subgroup.
const CHUNK: u32 = 1024;

/// The kernels of a norm that is used several times.
#[derive(Debug)]
pub(super) struct Norm {
    channels: u32,
    statistics: Pipeline<norm_statistics::Kernel>,
    merge: Pipeline<norm_merge::Kernel>,
    forward: Pipeline<norm_forward::Kernel>,
    backward_sums: Pipeline<norm_backward_sums::Kernel>,
    backward_merge: Pipeline<norm_backward_merge::Kernel>,
    backward: Pipeline<norm_backward::Kernel>,
}

/// State between forward and backward, and scratch memory.
#[derive(Debug)]
pub(super) struct NormMemory {
    /// (uses, C)
    statistics: Buffer<ChannelStatistics>,
    /// (C, chunks)
    partials: Buffer<Vec2>,
    /// (C,)
    sums: Buffer<Vec2>,
}

/// One use of a norm: pixels, offset of its parameters, and index of the use.
#[derive(Clone, Copy, Debug)]
pub(super) struct NormUse {
    pub(super) pixel_count: u32,
    pub(super) offset: u32,
    pub(super) repeat: u32,
}

/// The images of the forward pass, each (C, H, W).
#[derive(Debug)]
pub(super) struct Forward<'a> {
    /// z
    pub(super) source: &'a Buffer<f32>,
    /// f
    pub(super) shortcut: &'a Buffer<f32>,
    /// f'
    pub(super) target: &'a mut Buffer<f32>,
}

/// The push constants of all six kernels.
macro_rules! params {
    ($norm:ident, $of:ident, $kernel:ident) => {
        $kernel::Params {
            pixel_count: $of.pixel_count,
            channel_count: $norm.channels,
            offset: $of.offset,
            slot: $of.repeat * $norm.channels,
        }
    };
}

impl Norm {
    pub(super) fn new(gpu: &Gpu, channels: u32) -> Result<Self> {
        let chunk = CHUNK;
        Ok(Self {
            channels,
            statistics: gpu.pipeline(&norm_statistics::Constants { chunk })?,
            merge: gpu.pipeline(&norm_merge::Constants { chunk })?,
            forward: gpu.pipeline(&norm_forward::Constants { chunk })?,
            backward_sums: gpu.pipeline(&norm_backward_sums::Constants { chunk })?,
            backward_merge: gpu.pipeline(&norm_backward_merge::Constants { chunk })?,
            backward: gpu.pipeline(&norm_backward::Constants { chunk })?,
        })
    }

    /// Measures z and writes f'.
    pub(super) fn forward(
        &self,
        pass: &mut Recorder<'_>,
        of: NormUse,
        values: &Buffer<f32>,
        memory: &mut NormMemory,
        Forward { source, shortcut, target }: Forward<'_>,
    ) -> Result<()> {
        let NormMemory { statistics, partials, .. } = memory;
        let (per_chunk, per_channel) = self.threads(of);
        pass.dispatch(
            &self.statistics,
            &params!(self, of, norm_statistics),
            norm_statistics::Buffers { source: source.slice(), partials: partials.slice_mut() },
            per_chunk,
        )?;
        pass.dispatch(
            &self.merge,
            &params!(self, of, norm_merge),
            norm_merge::Buffers { partials: partials.slice(), statistics: statistics.slice_mut() },
            per_channel,
        )?;
        pass.dispatch(
            &self.forward,
            &params!(self, of, norm_forward),
            norm_forward::Buffers {
                values: values.slice(),
                statistics: statistics.slice(),
                source: source.slice(),
                shortcut: shortcut.slice(),
                target: target.slice_mut(),
            },
            per_chunk,
        )
    }

    /// Writes dL/dz from z and dL/df', and adds the gradients of gamma and beta.
    pub(super) fn backward(
        &self,
        pass: &mut Recorder<'_>,
        of: NormUse,
        values: &Buffer<f32>,
        gradients: &mut Buffer<f32>,
        memory: &mut NormMemory,
        Backward { source, d_target, d_source }: Backward<'_>,
    ) -> Result<()> {
        let NormMemory { statistics, partials, sums } = memory;
        let (per_chunk, per_channel) = self.threads(of);
        pass.dispatch(
            &self.backward_sums,
            &params!(self, of, norm_backward_sums),
            norm_backward_sums::Buffers {
                values: values.slice(),
                statistics: statistics.slice(),
                source: source.slice(),
                d_target: d_target.slice(),
                partials: partials.slice_mut(),
            },
            per_chunk,
        )?;
        pass.dispatch(
            &self.backward_merge,
            &params!(self, of, norm_backward_merge),
            norm_backward_merge::Buffers {
                partials: partials.slice(),
                sums: sums.slice_mut(),
                gradients: gradients.slice_mut(),
            },
            per_channel,
        )?;
        pass.dispatch(
            &self.backward,
            &params!(self, of, norm_backward),
            norm_backward::Buffers {
                values: values.slice(),
                statistics: statistics.slice(),
                sums: sums.slice(),
                source: source.slice(),
                d_target: d_target.slice(),
                d_source: d_source.slice_mut(),
            },
            per_chunk,
        )
    }

    /// One workgroup per chunk and channel, and one per channel.
    fn threads(&self, of: NormUse) -> (Threads, Threads) {
        let per_chunk = [of.pixel_count.div_ceil(CHUNK), self.channels, 1];
        (Threads::Workgroups(per_chunk), Threads::Workgroups([1, self.channels, 1]))
    }
}

impl NormMemory {
    pub(super) fn new(gpu: &Gpu, pixels: usize, channels: usize, uses: usize) -> Result<Self> {
        Ok(Self {
            statistics: gpu.uninit("norm_statistics", uses * channels)?,
            partials: gpu.uninit("norm_partials", channels * pixels.div_ceil(CHUNK as usize))?,
            sums: gpu.uninit("norm_sums", channels)?,
        })
    }

    /// Its size in floats.
    pub(super) fn floats(pixels: usize, channels: usize, uses: usize) -> usize {
        2 * channels * (uses + pixels.div_ceil(CHUNK as usize) + 1)
    }
}
