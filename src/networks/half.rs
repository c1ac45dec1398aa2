//! A 3x3 convolution by 16-bit matrices: its kernels, and its packed factors.

use glam::UVec2;

use super::conv::{HALF_STRIP_ROWS, Layer, Reduce, Strips};
use super::{WORKGROUP_THREADS, side_by_side};
use crate::Result;
use crate::gpu::{Buffer, CooperativeMatrix, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::packed::{PACKED_CHANNELS, PACKED_COLUMNS, PACKED_ROWS};
use crate::kernels::{
    conv3x3_half, conv3x3_weight_gradient_half, largest_magnitude, pack_map, pack_weights,
    unpack_map,
};

/// Subgroups of a workgroup, and matrices of output channels per subgroup, times four rows of pixels. The first whose
/// pixels and weights fit shared memory, and whose sums fit the registers, is taken.
const SHAPES: [[u32; 2]; 5] = [[4, 4], [4, 2], [4, 1], [2, 2], [1, 1]];

/// Values of a matrix for each matrix of output channels: devices with small matrices have few registers (compiled by
/// Mesa 26 for Arc).
const BLOCK_VALUES: u32 = 64;

/// Values per subgroup of the search for the largest magnitude.
const CHUNK: u32 = 2048;

/// Eight halves.
type HalfVec8 = [u32; 4];

/// Feature maps as a factor, and the bits of their bound.
#[derive(Debug)]
pub(super) struct PackedMap {
    pub(super) bound: Buffer<u32>,
    pub(super) halves: Buffer<HalfVec8>,
}

impl PackedMap {
    /// Allocates this number of groups of eight halves.
    pub(super) fn new(gpu: &Gpu, packed_count: usize) -> Result<Self> {
        let bound = gpu.uninit("bound", packed_count.min(1))?;
        Ok(Self { bound, halves: gpu.uninit("packed_map", packed_count)? })
    }

    /// The groups of eight halves of a view.
    pub(super) fn packed_count(size: UVec2, channels: u32) -> usize {
        packed_pixels(size) as usize * packed_channels(channels) as usize / 8
    }
}

/// The pixels of a packed map, with those around it.
pub(super) fn packed_pixels(UVec2 { x, y }: UVec2) -> u32 {
    (x.next_multiple_of(PACKED_COLUMNS) + 2) * (y.next_multiple_of(PACKED_ROWS) + 2)
}

/// The channels of a packed map, with those that are zero.
pub(super) fn packed_channels(channels: u32) -> u32 {
    channels.next_multiple_of(PACKED_CHANNELS)
}

/// The weights of a layer as factors of both directions, and the bits of their bound.
#[derive(Debug)]
pub(super) struct PackedWeights {
    bound: Buffer<u32>,
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

/// The kernels of a convolution with equal numbers of input and output channels and without biases; a layer's weights
/// are at an offset of the values.
#[derive(Debug)]
pub(super) struct HalfConv {
    channels: u32,
    matrix: CooperativeMatrix,
    /// Of [`SHAPES`].
    shape: [u32; 2],
    largest: Pipeline<largest_magnitude::Kernel>,
    pack_map: Pipeline<pack_map::Kernel>,
    unpack_map: Pipeline<unpack_map::Kernel>,
    pack_weights: [Pipeline<pack_weights::Kernel>; 2],
    products: [Pipeline<conv3x3_half::Kernel>; 2],
    weight_gradient: Pipeline<conv3x3_weight_gradient_half::Kernel>,
    gradient_subgroups: u32,
    reduce: Reduce,
}

/// The most that a workgroup has in shared memory, in bytes: pixels and weights with eight halves beside every K of
/// them, and sums.
fn shared_bytes(
    [subgroups, blocks]: [u32; 2],
    CooperativeMatrix { m, n, k }: CooperativeMatrix,
) -> u32 {
    let staged = (subgroups * PACKED_ROWS + 2) * (n + 2) + 9 * m * blocks;
    2 * (k + 8) * staged + 4 * subgroups * m * n
}

impl HalfConv {
    pub(super) fn new(gpu: &Gpu, channels: u32, matrix: CooperativeMatrix) -> Result<Self> {
        let CooperativeMatrix { m, n, k } = matrix;
        let device = gpu.properties();
        let fits = |shape: &[u32; 2]| {
            shared_bytes(*shape, matrix) <= device.max_shared_memory
                && shape[1] * BLOCK_VALUES <= m * n
                && shape[0] * device.subgroup_size <= WORKGROUP_THREADS
        };
        let [subgroups, blocks] = SHAPES.into_iter().find(fits).unwrap_or(SHAPES[SHAPES.len() - 1]);
        let gradient_subgroups = side_by_side(gpu, packed_channels(channels) / n);
        let blocks = blocks.min(packed_channels(channels) / m);
        let pack_weights = |transposed| gpu.pipeline(&pack_weights::Constants { transposed });
        let product = |accumulate| {
            gpu.pipeline(&conv3x3_half::Constants { m, n, k, blocks, subgroups, accumulate })
        };
        Ok(Self {
            channels,
            matrix,
            shape: [subgroups, blocks],
            largest: gpu.pipeline(&largest_magnitude::Constants { chunk: CHUNK })?,
            pack_map: gpu.pipeline(&pack_map::Constants::default())?,
            unpack_map: gpu.pipeline(&unpack_map::Constants::default())?,
            pack_weights: [pack_weights(false)?, pack_weights(true)?],
            products: [product(false)?, product(true)?],
            weight_gradient: gpu.pipeline(&conv3x3_weight_gradient_half::Constants {
                m,
                n,
                k,
                rows: HALF_STRIP_ROWS,
                subgroups: gradient_subgroups,
                tap_columns: if m * n < 3 * BLOCK_VALUES { 1 } else { 3 },
            })?,
            gradient_subgroups,
            reduce: Reduce::new(gpu)?,
        })
    }

    /// Allocates for the weights of a layer.
    pub(super) fn packed_weights(&self, gpu: &Gpu) -> Result<PackedWeights> {
        let halves = || gpu.uninit("packed_weights", self.packed_weight_count() as usize);
        let bound = gpu.uninit("weight_bound", 1)?;
        Ok(PackedWeights { bound, halves: [halves()?, halves()?] })
    }

    fn packed_weight_count(&self) -> u32 {
        9 * packed_channels(self.channels).pow(2) / 8
    }

    fn weight_count(&self) -> u32 {
        9 * self.channels * self.channels
    }

    /// Packs the weights of a layer; for the backward direction after the forward one.
    pub(super) fn pack_weights(
        &self,
        pass: &mut Recorder<'_>,
        way: Direction,
        Layer { offset, values }: Layer<'_>,
        packed: &mut PackedWeights,
    ) -> Result<()> {
        let PackedWeights { bound, halves } = packed;
        if let Direction::Forward = way {
            self.largest(pass, [offset, self.weight_count()], values, bound)?;
        }
        let (in_channels, out_channels) = (self.channels, self.channels);
        pass.dispatch(
            &self.pack_weights[way as usize],
            &pack_weights::Params { in_channels, out_channels, offset },
            pack_weights::Buffers {
                bound: bound.slice(),
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
        let (channels, PackedMap { bound, halves }) = (self.channels, packed);
        self.largest(pass, [0, channels * size.element_product()], source, bound)?;
        let blocks = packed_pixels(size) * channels.div_ceil(PACKED_CHANNELS);
        pass.dispatch(
            &self.pack_map,
            &pack_map::Params { size, channels },
            pack_map::Buffers {
                bound: bound.slice(),
                source: source.slice(),
                packed: halves.slice_mut(),
            },
            Threads::Exactly([blocks, 1, 1]),
        )
    }

    /// Writes packed maps as (C, H, W).
    pub(super) fn unpack_map(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        PackedMap { bound, halves }: &PackedMap,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        let channels = self.channels;
        pass.dispatch(
            &self.unpack_map,
            &unpack_map::Params { size, channels },
            unpack_map::Buffers {
                bound: bound.slice(),
                packed: halves.slice(),
                target: target.slice_mut(),
            },
            Threads::Exactly([size.element_product() * channels.div_ceil(PACKED_CHANNELS), 1, 1]),
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

    /// Writes the convolution of the packed `source` in a direction, with the weights packed for it; in the backward
    /// direction, added to `shortcut`.
    #[expect(clippy::too_many_arguments, reason = "the factors, and what is added to")]
    pub(super) fn product(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        way: Direction,
        weights: &PackedWeights,
        source: &PackedMap,
        shortcut: Option<ShortcutMap<'_>>,
        target: &mut PackedMap,
    ) -> Result<()> {
        // The forward kernel binds something, and reads nothing of it.
        let shortcut =
            shortcut.unwrap_or(ShortcutMap { largest: &source.bound, index: 0, map: source });
        let (in_channels, out_channels) = (self.channels, self.channels);
        let (CooperativeMatrix { m, n, .. }, [subgroups, blocks]) = (self.matrix, self.shape);
        pass.dispatch(
            &self.products[way as usize],
            &conv3x3_half::Params {
                size,
                in_channels,
                out_channels,
                largest_index: shortcut.index,
            },
            conv3x3_half::Buffers {
                weight_bound: weights.bound.slice(),
                source_bound: source.bound.slice(),
                shortcut_largest: shortcut.largest.slice(),
                shortcut_bound: shortcut.map.bound.slice(),
                weights: weights.halves[way as usize].slice(),
                source: source.halves.slice(),
                shortcut: shortcut.map.halves.slice(),
                target_bound: target.bound.slice_mut(),
                target: target.halves.slice_mut(),
            },
            Threads::Workgroups([
                packed_channels(out_channels).div_ceil(blocks * m),
                size.x.div_ceil(n),
                size.y.div_ceil(subgroups * PACKED_ROWS),
            ]),
        )
    }

    /// Adds the gradients of the weights, from the input and the gradient of the output.
    pub(super) fn weight_gradient(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        offset: u32,
        [source, d_target]: [&PackedMap; 2],
        strips: &mut Strips<'_>,
    ) -> Result<()> {
        let (in_channels, out_channels) = (self.channels, self.channels);
        let CooperativeMatrix { m, n, .. } = self.matrix;
        let strip_count = size.y.div_ceil(HALF_STRIP_ROWS);
        pass.dispatch(
            &self.weight_gradient,
            &conv3x3_weight_gradient_half::Params { size, in_channels, out_channels },
            conv3x3_weight_gradient_half::Buffers {
                source_bound: source.bound.slice(),
                d_target_bound: d_target.bound.slice(),
                source: source.halves.slice(),
                d_target: d_target.halves.slice(),
                partials: strips.partials.slice_mut(),
            },
            Threads::Workgroups([
                packed_channels(in_channels).div_ceil(n * self.gradient_subgroups),
                out_channels.div_ceil(m),
                strip_count,
            ]),
        )?;
        self.reduce.record(pass, self.weight_count(), strip_count, offset, strips)
    }
}

/// A map that a gradient is added to, and where the bits of its largest magnitude are.
#[derive(Clone, Copy, Debug)]
pub(super) struct ShortcutMap<'a> {
    pub(super) largest: &'a Buffer<u32>,
    pub(super) index: u32,
    pub(super) map: &'a PackedMap,
}
