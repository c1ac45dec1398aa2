//! A 3x3 convolution by 16-bit matrices: its kernels, and its packed factors.

use glam::UVec2;

use super::conv::{AccumulateInto, HALF_STRIP_ROWS, Layer, Reduce, Strips};
use crate::Result;
use crate::gpu::{Buffer, CooperativeMatrix, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::packed::{PACKED_CHANNELS, PACKED_COLUMNS, PACKED_ROWS};
use crate::kernels::{
    conv3x3_half, conv3x3_weight_gradient_half, largest_magnitude, pack_map, pack_weights,
};

/// The most matrices of output channels per subgroup, times four rows of pixels: sixteen sums in registers.
const BLOCKS: u32 = 4;

/// Values per subgroup of the search for the largest magnitude.
const CHUNK: u32 = 2048;

/// Eight halves.
type HalfVec8 = [u32; 4];

/// Feature maps as a factor, and the bits of their largest magnitude.
#[derive(Debug)]
pub(super) struct PackedMap {
    largest: Buffer<u32>,
    halves: Buffer<HalfVec8>,
}

impl PackedMap {
    /// Allocates this number of groups of eight halves.
    pub(super) fn new(gpu: &Gpu, packed_count: usize) -> Result<Self> {
        let largest = gpu.uninit("largest", packed_count.min(1))?;
        Ok(Self { largest, halves: gpu.uninit("packed_map", packed_count)? })
    }

    /// The groups of eight halves of a view.
    pub(super) fn packed_count(size: UVec2, channels: u32) -> usize {
        let columns = size.x.next_multiple_of(PACKED_COLUMNS) as usize + 2;
        let rows = size.y.next_multiple_of(PACKED_ROWS) as usize + 2;
        columns * rows * channels.next_multiple_of(PACKED_CHANNELS) as usize / 8
    }
}

/// The weights of a layer as factors of both directions, and the bits of their largest magnitude.
#[derive(Debug)]
pub(super) struct PackedWeights {
    largest: Buffer<u32>,
    halves: [Buffer<HalfVec8>; 2],
}

/// The direction of a convolution.
#[derive(Clone, Copy, Debug)]
pub(super) enum Direction {
    /// From input to output.
    Forward = 0,
    /// From the gradient of the output to that of the input.
    Backward = 1,
}

/// The kernels of a convolution with equal numbers of input and output channels; a layer's weights and biases are at an
/// offset of the values.
#[derive(Debug)]
pub(super) struct HalfConv {
    channels: u32,
    matrix: CooperativeMatrix,
    /// Matrices of output channels per subgroup.
    blocks: u32,
    largest: Pipeline<largest_magnitude::Kernel>,
    pack_map: Pipeline<pack_map::Kernel>,
    pack_weights: [Pipeline<pack_weights::Kernel>; 2],
    products: [Pipeline<conv3x3_half::Kernel>; 2],
    weight_gradient: Pipeline<conv3x3_weight_gradient_half::Kernel>,
    reduce: Reduce,
}

impl HalfConv {
    pub(super) fn new(
        gpu: &Gpu,
        channels: u32,
        matrix: CooperativeMatrix,
        adds: AccumulateInto,
    ) -> Result<Self> {
        let CooperativeMatrix { m, n, k } = matrix;
        let blocks = channels.div_ceil(m).min(BLOCKS);
        let pack_weights = |transposed| gpu.pipeline(&pack_weights::Constants { transposed });
        let product = |biased, target| {
            let accumulate = adds == target;
            gpu.pipeline(&conv3x3_half::Constants { m, n, k, blocks, biased, accumulate })
        };
        Ok(Self {
            channels,
            matrix,
            blocks,
            largest: gpu.pipeline(&largest_magnitude::Constants { chunk: CHUNK })?,
            pack_map: gpu.pipeline(&pack_map::Constants::default())?,
            pack_weights: [pack_weights(false)?, pack_weights(true)?],
            products: [
                product(true, AccumulateInto::Output)?,
                product(false, AccumulateInto::InputGradient)?,
            ],
            weight_gradient: gpu.pipeline(&conv3x3_weight_gradient_half::Constants {
                m,
                n,
                k,
                rows: HALF_STRIP_ROWS,
            })?,
            reduce: Reduce::new(gpu)?,
        })
    }

    /// Allocates for the weights of a layer.
    pub(super) fn packed_weights(&self, gpu: &Gpu) -> Result<PackedWeights> {
        let halves = || gpu.uninit("packed_weights", self.packed_weight_count() as usize);
        let largest = gpu.uninit("largest_weight", 1)?;
        Ok(PackedWeights { largest, halves: [halves()?, halves()?] })
    }

    fn packed_weight_count(&self) -> u32 {
        9 * self.channels.next_multiple_of(PACKED_CHANNELS).pow(2) / 8
    }

    /// Packs the weights of a layer; for the backward direction after the forward one.
    pub(super) fn pack_weights(
        &self,
        pass: &mut Recorder<'_>,
        way: Direction,
        Layer { offset, values }: Layer<'_>,
        packed: &mut PackedWeights,
    ) -> Result<()> {
        let PackedWeights { largest, halves } = packed;
        if let Direction::Forward = way {
            let value_count = 9 * self.channels * self.channels;
            self.largest(pass, [offset, value_count], values, largest)?;
        }
        let (in_channels, out_channels) = (self.channels, self.channels);
        pass.dispatch(
            &self.pack_weights[way as usize],
            &pack_weights::Params { in_channels, out_channels, offset },
            pack_weights::Buffers {
                largest: largest.slice(),
                values: values.slice(),
                packed: halves[way as usize].slice_mut(),
            },
            Threads::Exactly([self.packed_weight_count(), 1, 1]),
        )
    }

    /// Packs maps (C, H, W).
    pub(super) fn pack_map(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        source: &Buffer<f32>,
        packed: &mut PackedMap,
    ) -> Result<()> {
        let (channels, PackedMap { largest, halves }) = (self.channels, packed);
        self.largest(pass, [0, channels * size.element_product()], source, largest)?;
        let packed_count = PackedMap::packed_count(size, channels) as u32;
        pass.dispatch(
            &self.pack_map,
            &pack_map::Params { size, channels },
            pack_map::Buffers {
                largest: largest.slice(),
                source: source.slice(),
                packed: halves.slice_mut(),
            },
            Threads::Exactly([packed_count / (PACKED_CHANNELS / 8), 1, 1]),
        )
    }

    fn largest(
        &self,
        pass: &mut Recorder<'_>,
        [offset, value_count]: [u32; 2],
        values: &Buffer<f32>,
        largest: &mut Buffer<u32>,
    ) -> Result<()> {
        pass.fill(largest, 0);
        pass.dispatch(
            &self.largest,
            &largest_magnitude::Params { offset, value_count },
            largest_magnitude::Buffers { values: values.slice(), largest: largest.slice_mut() },
            Threads::Workgroups([value_count.div_ceil(CHUNK), 1, 1]),
        )
    }

    /// Writes or adds the convolution of the packed `source` in a direction, (C, H, W), with the weights packed for it.
    #[expect(clippy::too_many_arguments, reason = "a layer and its packed images")]
    pub(super) fn product(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        way: Direction,
        Layer { offset, values }: Layer<'_>,
        weights: &PackedWeights,
        source: &PackedMap,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        let (in_channels, out_channels) = (self.channels, self.channels);
        let CooperativeMatrix { m, n, .. } = self.matrix;
        let biases = offset + 9 * in_channels * out_channels;
        pass.dispatch(
            &self.products[way as usize],
            &conv3x3_half::Params { size, in_channels, out_channels, biases },
            conv3x3_half::Buffers {
                largest_weight: weights.largest.slice(),
                largest_source: source.largest.slice(),
                values: values.slice(),
                weights: weights.halves[way as usize].slice(),
                source: source.halves.slice(),
                target: target.slice_mut(),
            },
            Threads::Workgroups([
                out_channels.div_ceil(self.blocks * m),
                size.x.div_ceil(n),
                size.y.div_ceil(PACKED_ROWS),
            ]),
        )
    }

    /// Adds the gradients of weights and biases, from the packed input and the gradient of the output, packed and
    /// unpacked.
    pub(super) fn weight_gradient(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        offset: u32,
        [source, d_target]: [&PackedMap; 2],
        d_target_single: &Buffer<f32>,
        strips: &mut Strips<'_>,
    ) -> Result<()> {
        let (in_channels, out_channels) = (self.channels, self.channels);
        let CooperativeMatrix { m, n, .. } = self.matrix;
        let strip_count = size.y.div_ceil(HALF_STRIP_ROWS);
        pass.dispatch(
            &self.weight_gradient,
            &conv3x3_weight_gradient_half::Params { size, in_channels, out_channels },
            conv3x3_weight_gradient_half::Buffers {
                largest_source: source.largest.slice(),
                largest_d_target: d_target.largest.slice(),
                source: source.halves.slice(),
                d_target: d_target.halves.slice(),
                d_target_single: d_target_single.slice(),
                partials: strips.partials.slice_mut(),
            },
            Threads::Workgroups([in_channels.div_ceil(n), out_channels.div_ceil(m), strip_count]),
        )?;
        self.reduce.record(pass, [in_channels, out_channels], strip_count, offset, strips)
    }
}
