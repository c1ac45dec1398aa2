//! The norm of [`Norm`](super::norm::Norm) on packed maps.

use super::half::{PackedMap, packed_channels, packed_pixels};
use super::norm::{NormMemory, NormMerge, NormUse};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::packed::PACKED_CHANNELS;
use crate::kernels::{
    norm_backward_half, norm_backward_sums_half, norm_forward_half, norm_statistics_half,
};

/// Pixels per subgroup.
pub(super) const HALF_CHUNK: u32 = 128;

/// The kernels of a norm that is used several times.
#[derive(Debug)]
pub(super) struct HalfNorm {
    channels: u32,
    statistics: Pipeline<norm_statistics_half::Kernel>,
    forward: Pipeline<norm_forward_half::Kernel>,
    backward_sums: Pipeline<norm_backward_sums_half::Kernel>,
    backward: Pipeline<norm_backward_half::Kernel>,
    merge: NormMerge,
}

/// The push constants of a kernel of packed maps.
macro_rules! params {
    ($norm:ident, $of:ident, $kernel:ident) => {
        $kernel::Params {
            size: $of.size,
            channel_count: $norm.channels,
            offset: $of.offset,
            slot: $of.repeat * $norm.channels,
            most_normalised: ($of.size.element_product() as f32).sqrt(),
        }
    };
}

impl HalfNorm {
    pub(super) fn new(gpu: &Gpu, channels: u32) -> Result<Self> {
        let chunk = HALF_CHUNK;
        Ok(Self {
            channels,
            statistics: gpu.pipeline(&norm_statistics_half::Constants { chunk })?,
            forward: gpu.pipeline(&norm_forward_half::Constants { chunk })?,
            backward_sums: gpu.pipeline(&norm_backward_sums_half::Constants { chunk })?,
            backward: gpu.pipeline(&norm_backward_half::Constants { chunk })?,
            merge: NormMerge::new(gpu, channels, chunk)?,
        })
    }

    /// Measures z and writes f', with zeros around it, from z and f.
    pub(super) fn forward(
        &self,
        pass: &mut Recorder<'_>,
        of: NormUse,
        values: &Buffer<f32>,
        memory: &mut NormMemory,
        [source, shortcut]: [&PackedMap; 2],
        target: &mut PackedMap,
    ) -> Result<()> {
        pass.dispatch(
            &self.statistics,
            &params!(self, of, norm_statistics_half),
            norm_statistics_half::Buffers {
                source_bound: source.bound.slice(),
                source: source.halves.slice(),
                partials: memory.partials.slice_mut(),
            },
            self.chunks(of.size.element_product()),
        )?;
        self.merge.statistics(pass, of, memory)?;
        pass.dispatch(
            &self.forward,
            &params!(self, of, norm_forward_half),
            norm_forward_half::Buffers {
                values: values.slice(),
                statistics: memory.statistics.slice(),
                source_bound: source.bound.slice(),
                source: source.halves.slice(),
                shortcut_bound: shortcut.bound.slice(),
                shortcut: shortcut.halves.slice(),
                target_bound: target.bound.slice_mut(),
                target: target.halves.slice_mut(),
            },
            self.chunks(packed_pixels(of.size)),
        )
    }

    /// Writes dL/dz, with zeros around it, from z and dL/df', adds the gradients of gamma and beta, and leaves the
    /// largest magnitude of dL/df' in `memory`, whose word of this use was 0.
    #[expect(clippy::too_many_arguments, reason = "two maps in, two gradients out")]
    pub(super) fn backward(
        &self,
        pass: &mut Recorder<'_>,
        of: NormUse,
        values: &Buffer<f32>,
        gradients: &mut Buffer<f32>,
        memory: &mut NormMemory,
        [source, d_target]: [&PackedMap; 2],
        d_source: &mut PackedMap,
    ) -> Result<()> {
        pass.dispatch(
            &self.backward_sums,
            &params!(self, of, norm_backward_sums_half),
            norm_backward_sums_half::Buffers {
                values: values.slice(),
                statistics: memory.statistics.slice(),
                source_bound: source.bound.slice(),
                source: source.halves.slice(),
                d_target_bound: d_target.bound.slice(),
                d_target: d_target.halves.slice(),
                partials: memory.partials.slice_mut(),
                largest: memory.largest.slice_mut(),
            },
            self.chunks(of.size.element_product()),
        )?;
        self.merge.sums(pass, of, gradients, memory)?;
        pass.dispatch(
            &self.backward,
            &params!(self, of, norm_backward_half),
            norm_backward_half::Buffers {
                values: values.slice(),
                statistics: memory.statistics.slice(),
                source_bound: source.bound.slice(),
                source: source.halves.slice(),
                sums: memory.sums.slice(),
                largest: memory.largest.slice(),
                d_target_bound: d_target.bound.slice(),
                d_target: d_target.halves.slice(),
                d_source_bound: d_source.bound.slice_mut(),
                d_source: d_source.halves.slice_mut(),
            },
            self.chunks(packed_pixels(of.size)),
        )
    }

    /// One workgroup per chunk of pixels and sixteen channels.
    fn chunks(&self, pixels: u32) -> Threads {
        let blocks = packed_channels(self.channels) / PACKED_CHANNELS;
        Threads::Workgroups([pixels.div_ceil(HALF_CHUNK), blocks, 1])
    }
}
