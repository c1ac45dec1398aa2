//! The memory of one view: intermediate buffers of a render.

use glam::UVec2;

use super::Purpose;
use super::lists::Lists;
use crate::Result;
use crate::gpu::{Buffer, Gpu};
use crate::kernels::splat::RECORD_HEAD;
use crate::kernels::status::{
    STATUS_GRADIENT, STATUS_NOT_FINITE, STATUS_OVERFLOWED, STATUS_TILE_LIMIT, STATUS_WORDS,
};
use crate::kernels::{self, InstanceView, ProjectedSplat};

/// The first estimate of tiles per Gaussian; a view that needs more grows the memory.
const TILES_PER_GAUSSIAN: u32 = 6;
/// The same without gradients, where an intersection takes a fifth of the bytes, and the least estimate: a first draw
/// should not have to leave out any.
const SHOWN_TILES_PER_GAUSSIAN: u32 = 16;
const LEAST_SHOWN_INTERSECTIONS: u32 = 1 << 20;

/// Depth ranks whose tiles one subgroup counts. With more, fewer subgroups would share the loads; with fewer, the last
/// one would have more sums to add up.
pub(super) const RANKS_PER_PARTITION: u32 = 1024;

/// The decoded status words.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Status {
    /// More intersections than memory was reserved for.
    pub overflowed: bool,
    /// A loss term is NaN or infinite.
    pub not_finite: bool,
    /// A gradient of a Gaussian is NaN or infinite, and no earlier flag was set.
    pub gradient_not_finite: bool,
    /// The most intersections of a render since the status was cleared.
    pub intersections: u32,
    /// The most splats of one tile where they exceed the device's limit; else 0.
    pub splats_per_tile: u32,
}

impl Status {
    /// Decodes the words that [`super::Renderer::status`] holds.
    pub fn from_words(words: &[u32]) -> Self {
        let word = |i: usize| words.get(i).copied().unwrap_or_default();
        Self {
            overflowed: word(0) & STATUS_OVERFLOWED != 0,
            not_finite: word(0) & STATUS_NOT_FINITE != 0,
            gradient_not_finite: word(0) & STATUS_GRADIENT != 0,
            intersections: word(1),
            splats_per_tile: if word(0) & STATUS_TILE_LIMIT == 0 { 0 } else { word(2) },
        }
    }
}

/// The intermediate buffers, grouped by what determines their length. Public for tests only.
#[derive(Debug)]
#[allow(missing_docs, reason = "each is declared in the kernels that write and read it")]
pub struct RenderBuffers {
    /// Values per pixel.
    channels: usize,
    purpose: Purpose,
    pub(super) segments: Segments,
    // Gaussians
    /// `[0]`: the number of rendered Gaussians
    pub gaussian_counts: Buffer<u32>,
    pub splats: Buffer<ProjectedSplat>,
    pub colors: Buffer<f32>,
    pub depth_keys: Buffer<u32>,
    pub ids: Buffer<u32>,
    pub tile_counts: Buffer<u32>,
    pub intersection_offsets: Buffer<u32>,
    /// One per partition of ranks.
    pub sums: Buffer<u32>,
    // intersections
    pub lists: Lists,
    pub gradient_records: Buffer<f32>,
    /// The pixels of each tile before the segments of its run after the first.
    pub segment_states: Buffer<f32>,
    // pixels and tiles
    pub render: Buffer<f32>,
    pub transmittances: Buffer<f32>,
    pub tile_ranges: Buffer<UVec2>,
    /// The camera of a view without a camera in another buffer.
    pub camera: Buffer<kernels::Camera>,
    /// As that camera sees them.
    pub instances: Buffer<InstanceView>,
    // single numbers
    pub status: Buffer<u32>,
    /// Workgroups of `order_counts` that are done; 0 between renders.
    pub arrivals: Buffer<u32>,
    /// Bound where tiles are not counted.
    pub(super) no_sizes: Buffer<u32>,
}

impl RenderBuffers {
    /// Empty but for the single numbers.
    pub(super) fn new(
        gpu: &Gpu,
        channels: usize,
        purpose: Purpose,
        segments: Segments,
    ) -> Result<Self> {
        Ok(Self {
            channels,
            purpose,
            segments,
            gaussian_counts: gpu.zeros("gaussian_counts", 1)?,
            splats: gpu.uninit("splats", 0)?,
            colors: gpu.uninit("colors", 0)?,
            depth_keys: gpu.uninit("depth_keys", 0)?,
            ids: gpu.uninit("ids", 0)?,
            tile_counts: gpu.uninit("tile_counts", 0)?,
            intersection_offsets: gpu.uninit("intersection_offsets", 0)?,
            sums: gpu.uninit("sums", 1)?,
            lists: Lists::new(gpu, 0, 0)?,
            gradient_records: gpu.uninit("gradient_records", 0)?,
            segment_states: gpu.uninit("segment_states", 1)?,
            render: gpu.uninit("render", 0)?,
            transmittances: gpu.uninit("transmittances", 0)?,
            tile_ranges: gpu.uninit("tile_ranges", 0)?,
            camera: gpu.zeros("camera", 1)?,
            instances: gpu.zeros("instances", 1)?,
            status: gpu.zeros("status", STATUS_WORDS as usize)?,
            arrivals: gpu.zeros("arrivals", 1)?,
            no_sizes: gpu.zeros("tile_sizes", 1)?,
        })
    }

    /// Values per pixel; they only grow.
    pub(super) fn set_channels(&mut self, gpu: &Gpu, channels: usize) -> Result<()> {
        if channels <= self.channels {
            return Ok(());
        }
        let pixels = self.render.len() / self.channels;
        self.colors.grow(gpu, color_floats(channels) * self.splats.len())?;
        self.render = gpu.uninit("render", channels * pixels)?;
        self.channels = channels;
        Ok(())
    }

    /// Lengths only grow: to `capacity` where they do not suffice for `count` Gaussians; intersections start with an
    /// estimate.
    pub(super) fn reserve(
        &mut self,
        gpu: &Gpu,
        count: usize,
        capacity: usize,
        pixels: usize,
        tiles: usize,
    ) -> Result<()> {
        if self.splats.len() < count {
            let count = capacity.max(count);
            self.colors = gpu.uninit("colors", color_floats(self.channels) * count)?;
            self.depth_keys = gpu.uninit("depth_keys", count)?;
            self.ids = gpu.uninit("ids", count)?;
            self.tile_counts = gpu.uninit("tile_counts", count)?;
            self.intersection_offsets = gpu.uninit("intersection_offsets", count)?;
            let partitions = (count as u32).div_ceil(RANKS_PER_PARTITION).max(1);
            self.sums = gpu.uninit("sums", partitions as usize)?;
            self.lists.intersection_ranges = gpu.uninit("intersection_ranges", count)?;
            // Its length says that the others are there.
            self.splats = gpu.uninit("splats", count)?;
        }
        self.transmittances.grow(gpu, pixels)?;
        self.render.grow(gpu, self.channels * pixels)?;
        self.tile_ranges.grow(gpu, tiles)?;
        if self.intersection_capacity() == 0 {
            let count = count.max(1024) as u32;
            let guess = match self.purpose {
                Purpose::Train => count.saturating_mul(TILES_PER_GAUSSIAN),
                Purpose::Show => {
                    count.saturating_mul(SHOWN_TILES_PER_GAUSSIAN).max(LEAST_SHOWN_INTERSECTIONS)
                }
            };
            self.set_intersection_capacity(gpu, guess.min(self.max_intersections(gpu)))?;
        }
        Ok(())
    }

    /// Grows the capacity while earlier renders may be in flight; where memory is out, it is as it was.
    pub(super) fn grow_intersections(&mut self, gpu: &Gpu, capacity: u32) -> Result<()> {
        let capacity = capacity as usize;
        let records = gpu.uninit("gradient_records", self.record_floats() * capacity)?;
        let states = gpu.uninit("segment_states", self.state_floats(capacity))?;
        self.lists.allocate(gpu, capacity)?;
        self.segment_states = states;
        self.gradient_records = records;
        Ok(())
    }

    pub(super) fn set_intersection_capacity(&mut self, gpu: &Gpu, capacity: u32) -> Result<()> {
        let capacity = capacity as usize;
        if capacity != self.lists.tiles.len() {
            // The old buffers are freed first: both together may exceed the memory.
            self.lists.allocate(gpu, 0)?;
            self.gradient_records = gpu.uninit("gradient_records", 0)?;
            self.segment_states = gpu.uninit("segment_states", 1)?;
            gpu.free_unused();
            self.gradient_records =
                gpu.uninit("gradient_records", self.record_floats() * capacity)?;
            self.segment_states = gpu.uninit("segment_states", self.state_floats(capacity))?;
            // Its length says that the others are there.
            self.lists.allocate(gpu, capacity)?;
        }
        Ok(())
    }

    /// Bytes per Gaussian.
    pub(super) fn bytes_per_gaussian(&self) -> usize {
        let color = color_floats(self.channels) * size_of::<f32>();
        let numbers = 4 * size_of::<f32>() + size_of::<UVec2>();
        size_of::<ProjectedSplat>() + color + numbers
    }

    /// Bytes per intersection.
    pub(super) fn bytes_per_intersection(&self) -> usize {
        let Segments { length, state } = self.segments;
        let state = if length == 0 { 0 } else { state.div_ceil(length) };
        Lists::BYTES_PER_INTERSECTION + (self.record_floats() + state as usize) * size_of::<f32>()
    }

    /// The floats of the states of segments, or one that is bound in their place.
    fn state_floats(&self, capacity: usize) -> usize {
        let blocks = self.segments.blocks(capacity as u32) as usize;
        (blocks * self.segments.state as usize).max(1)
    }

    /// The floats of a gradient record, in vectors of four; 0 without gradients.
    pub(super) fn record_floats(&self) -> usize {
        match self.purpose {
            Purpose::Train => (RECORD_HEAD as usize + self.channels).next_multiple_of(4),
            Purpose::Show => 0,
        }
    }

    /// The number of intersections whose records, segments, or ids, fit one binding.
    pub(super) fn max_intersections(&self, gpu: &Gpu) -> u32 {
        let record = (self.record_floats() * size_of::<f32>()).max(size_of::<u32>()) as u64;
        let bindable = gpu.properties().max_storage_buffer_range;
        let Segments { length, state } = self.segments;
        let state = u64::from(state) * size_of::<f32>() as u64;
        let in_segments = if length == 0 { u64::MAX } else { bindable / state * u64::from(length) };
        (bindable / record).min(in_segments).min(u32::MAX.into()) as u32
    }

    pub(super) fn intersection_capacity(&self) -> u32 {
        self.lists.tiles.len() as u32
    }
}

/// The segments of the run of a tile, which the backward pass blends side by side.
#[derive(Clone, Copy, Debug)]
pub(super) struct Segments {
    /// Splats; 0: a run has one segment.
    pub(super) length: u32,
    /// Floats of the state of a tile's pixels before a segment: transmittance and channels.
    pub(super) state: u32,
}

impl Segments {
    /// The blocks of `intersections`, each of which may have the start of a segment that is not the first of its tile.
    pub(super) fn blocks(self, intersections: u32) -> u32 {
        if self.length == 0 { 0 } else { intersections.div_ceil(self.length) }
    }
}

/// The floats of a splat's values, in vectors of four.
pub(super) fn color_floats(channels: usize) -> usize {
    channels.next_multiple_of(4)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_flag_is_read_from_its_own_bit() {
        let read = |flags| Status::from_words(&[flags, 5, 7]);
        let flags = |status: Status| {
            [
                status.overflowed,
                status.not_finite,
                status.gradient_not_finite,
                status.splats_per_tile == 7,
            ]
        };
        let all = [STATUS_OVERFLOWED, STATUS_NOT_FINITE, STATUS_GRADIENT, STATUS_TILE_LIMIT];
        for (index, flag) in all.into_iter().enumerate() {
            assert_eq!(flags(read(flag)), [0, 1, 2, 3].map(|at| at == index));
        }
        assert_eq!((flags(read(0)), read(0).intersections), ([false; 4], 5));
    }

    /// Counted against allocations; the difference is padding to rows of sixteen bytes and to whole partitions.
    #[test]
    fn gaussians_and_intersections_take_the_bytes_that_are_foreseen() {
        let gpu = Gpu::new(&crate::gpu::DeviceChoice::Best).unwrap();
        for channels in [3, 11] {
            let segments = Segments { length: 64, state: 256 * (channels as u32 + 1) };
            let mut frame = RenderBuffers::new(&gpu, channels, Purpose::Train, segments).unwrap();
            let before = gpu.memory_in_use();
            let (gaussians, intersections) = (100_000, 30_000);
            frame.reserve(&gpu, gaussians, gaussians, 0, 0).unwrap();
            frame.set_intersection_capacity(&gpu, intersections).unwrap();
            gpu.run("nothing", |_| Ok(())).unwrap();
            gpu.free_unused();
            let taken = (gpu.memory_in_use() - before) as f64;
            let foreseen = gaussians * frame.bytes_per_gaussian()
                + intersections as usize * frame.bytes_per_intersection();
            assert!((taken / foreseen as f64 - 1.0).abs() < 0.01, "{taken} {foreseen}");
        }
    }
}
