//! Norm, `ReLU` and shortcut of a repeat: f' = f + relu(gamma (z - mean) / deviation + beta), with the statistics of
//! the image.

use glam::{UVec2, Vec2};

use super::conv::Backward;
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{
    ChannelStatistics, norm_backward, norm_backward_merge, norm_backward_sums, norm_forward,
    norm_merge, norm_statistics,
};

/// Values of a channel per subgroup.
pub(super) const CHUNK: u32 = 1024;

/// The kernels of a norm that is used several times.
#[derive(Debug)]
pub(super) struct Norm {
    channels: u32,
    statistics: Pipeline<norm_statistics::Kernel>,
    forward: Pipeline<norm_forward::Kernel>,
    backward_sums: Pipeline<norm_backward_sums::Kernel>,
    backward: Pipeline<norm_backward::Kernel>,
    merge: NormMerge,
}

/// The kernels that merge the chunks of a channel.
#[derive(Debug)]
pub(super) struct NormMerge {
    channels: u32,
    statistics: Pipeline<norm_merge::Kernel>,
    sums: Pipeline<norm_backward_merge::Kernel>,
}

/// State between forward and backward, and scratch memory.
#[derive(Debug)]
pub(super) struct NormMemory {
    /// (uses, C)
    pub(super) statistics: Buffer<ChannelStatistics>,
    /// (C, chunks)
    pub(super) partials: Buffer<Vec2>,
    /// (C,)
    pub(super) sums: Buffer<Vec2>,
    /// (uses,): the largest magnitude of a packed gradient, as bits.
    pub(super) largest: Buffer<u32>,
}

/// One use of a norm: the size of its maps, offset of its parameters, and index of the use.
#[derive(Clone, Copy, Debug)]
pub(super) struct NormUse {
    pub(super) size: UVec2,
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

/// The push constants of all kernels.
macro_rules! norm_params {
    ($norm:ident, $of:ident, $kernel:ident) => {
        $kernel::Params {
            pixel_count: $of.size.element_product(),
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
            forward: gpu.pipeline(&norm_forward::Constants { chunk })?,
            backward_sums: gpu.pipeline(&norm_backward_sums::Constants { chunk })?,
            backward: gpu.pipeline(&norm_backward::Constants { chunk })?,
            merge: NormMerge::new(gpu, channels, chunk)?,
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
        let (NormMemory { partials, .. }, per_chunk) = (&mut *memory, self.threads(of));
        pass.dispatch(
            &self.statistics,
            &norm_params!(self, of, norm_statistics),
            norm_statistics::Buffers { source: source.slice(), partials: partials.slice_mut() },
            per_chunk,
        )?;
        self.merge.statistics(pass, of, memory)?;
        pass.dispatch(
            &self.forward,
            &norm_params!(self, of, norm_forward),
            norm_forward::Buffers {
                values: values.slice(),
                statistics: memory.statistics.slice(),
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
        let per_chunk = self.threads(of);
        pass.dispatch(
            &self.backward_sums,
            &norm_params!(self, of, norm_backward_sums),
            norm_backward_sums::Buffers {
                values: values.slice(),
                statistics: memory.statistics.slice(),
                source: source.slice(),
                d_target: d_target.slice(),
                partials: memory.partials.slice_mut(),
            },
            per_chunk,
        )?;
        self.merge.sums(pass, of, gradients, memory)?;
        pass.dispatch(
            &self.backward,
            &norm_params!(self, of, norm_backward),
            norm_backward::Buffers {
                values: values.slice(),
                statistics: memory.statistics.slice(),
                sums: memory.sums.slice(),
                source: source.slice(),
                d_target: d_target.slice(),
                d_source: d_source.slice_mut(),
            },
            per_chunk,
        )
    }

    /// One workgroup per chunk and channel.
    fn threads(&self, of: NormUse) -> Threads {
        Threads::Workgroups([of.size.element_product().div_ceil(CHUNK), self.channels, 1])
    }
}

impl NormMerge {
    pub(super) fn new(gpu: &Gpu, channels: u32, chunk: u32) -> Result<Self> {
        Ok(Self {
            channels,
            statistics: gpu.pipeline(&norm_merge::Constants { chunk })?,
            sums: gpu.pipeline(&norm_backward_merge::Constants { chunk })?,
        })
    }

    /// Merges the moments of chunks into the statistics of channels.
    pub(super) fn statistics(
        &self,
        pass: &mut Recorder<'_>,
        of: NormUse,
        NormMemory { statistics, partials, .. }: &mut NormMemory,
    ) -> Result<()> {
        pass.dispatch(
            &self.statistics,
            &norm_params!(self, of, norm_merge),
            norm_merge::Buffers { partials: partials.slice(), statistics: statistics.slice_mut() },
            Threads::Workgroups([1, self.channels, 1]),
        )
    }

    /// Merges the sums of chunks, and adds them to the gradients of gamma and beta.
    pub(super) fn sums(
        &self,
        pass: &mut Recorder<'_>,
        of: NormUse,
        gradients: &mut Buffer<f32>,
        NormMemory { partials, sums, .. }: &mut NormMemory,
    ) -> Result<()> {
        pass.dispatch(
            &self.sums,
            &norm_params!(self, of, norm_backward_merge),
            norm_backward_merge::Buffers {
                partials: partials.slice(),
                sums: sums.slice_mut(),
                gradients: gradients.slice_mut(),
            },
            Threads::Workgroups([1, self.channels, 1]),
        )
    }
}

impl NormMemory {
    pub(super) fn new(
        gpu: &Gpu,
        pixels: usize,
        channels: usize,
        uses: usize,
        chunk: u32,
    ) -> Result<Self> {
        Ok(Self {
            statistics: gpu.uninit("norm_statistics", uses * channels)?,
            partials: gpu.uninit("norm_partials", channels * pixels.div_ceil(chunk as usize))?,
            sums: gpu.uninit("norm_sums", channels)?,
            largest: gpu.uninit("norm_largest", uses)?,
        })
    }

    /// Its size in floats.
    pub(super) fn floats(pixels: usize, channels: usize, uses: usize, chunk: u32) -> usize {
        2 * channels * (uses + pixels.div_ceil(chunk as usize) + 1) + uses
    }
}
