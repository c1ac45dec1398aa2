//! The sort of each tile by itself: pairs of depth and slot go to their tile in any order, and a workgroup sorts them.
//!
//! It replaces two sorts of all Gaussians and intersections, whose passes wait for one another. Slots are in the order
//! of the Gaussians, so the pairs of a tile are unique and the result is the same every time.

use glam::UVec2;

use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads, WORKGROUP};
use crate::kernels::{place_pairs, sort_tiles, tile_begins};

/// Sorts the intersections of each tile by depth, those of equal depth by slot.
#[derive(Debug)]
pub struct TileSort {
    gpu: Gpu,
    begins_kernel: Pipeline<tile_begins::Kernel>,
    place: Pipeline<place_pairs::Kernel>,
    sort: Pipeline<sort_tiles::Kernel>,
    /// (tiles): the intersections of each; zeros between renders.
    pub sizes: Buffer<u32>,
    /// (tiles + 1)
    begins: Buffer<u32>,
    /// Depth keys and slots, by tile.
    pairs: Buffer<UVec2>,
}

/// Intersections by slot, and the depths of their Gaussians.
#[derive(Debug)]
pub struct UnsortedTiles<'a> {
    /// `[0]`: the number of intersections.
    pub counts: &'a Buffer<u32>,
    /// The Gaussian of each slot.
    pub gaussian_ids: &'a Buffer<u32>,
    /// Of each Gaussian.
    pub depth_keys: &'a Buffer<u32>,
    /// The tile of each slot; then of each intersection, ascending.
    pub tiles: &'a mut Buffer<u32>,
    /// The place of each slot in its tile; then the slot of each intersection.
    pub intersection_ids: &'a mut Buffer<u32>,
}

impl TileSort {
    /// With memory for no tile yet. On a CPU a workgroup is one subgroup: there, a barrier costs more than it saves.
    pub fn new(gpu: &Gpu) -> Result<Self> {
        let is_cpu = gpu.properties().is_cpu;
        let subgroups = if is_cpu { 1 } else { WORKGROUP / gpu.properties().subgroup_size };
        Self::with_capacity(gpu, subgroups.max(1), sort_tiles::Constants::default().capacity)
    }

    /// With workgroups of this many subgroups, and shared memory for `capacity` pairs, a power of two.
    pub fn with_capacity(gpu: &Gpu, subgroups: u32, capacity: u32) -> Result<Self> {
        Ok(Self {
            gpu: gpu.clone(),
            begins_kernel: gpu.pipeline(&tile_begins::Constants { subgroups })?,
            place: gpu.pipeline(&place_pairs::Constants {})?,
            sort: gpu.pipeline(&sort_tiles::Constants { subgroups, capacity })?,
            sizes: gpu.zeros("tile_sizes", 0)?,
            begins: gpu.uninit("tile_begins", 1)?,
            pairs: gpu.uninit("tile_pairs", 0)?,
        })
    }

    /// Its size in bytes per intersection.
    pub(crate) fn bytes_per_item() -> usize {
        size_of::<UVec2>()
    }

    /// Takes memory for views of up to `tiles` tiles, between recordings.
    pub fn reserve_tiles(&mut self, tiles: usize) -> Result<()> {
        if self.sizes.len() < tiles {
            self.sizes = self.gpu.zeros("tile_sizes", tiles)?;
            self.begins = self.gpu.uninit("tile_begins", tiles + 1)?;
        }
        Ok(())
    }

    /// Takes memory for `capacity` intersections.
    pub(crate) fn reserve(&mut self, capacity: usize) -> Result<()> {
        self.pairs.grow(&self.gpu, capacity)
    }

    /// Records the sort of a view of `tile_count` tiles, for which memory was taken. [`Self::sizes`] counts their
    /// intersections, and becomes zeros.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        tile_count: u32,
        unsorted: UnsortedTiles<'_>,
    ) -> Result<()> {
        let UnsortedTiles { counts, gaussian_ids, depth_keys, tiles, intersection_ids } = unsorted;
        self.reserve(tiles.len())?;
        let capacity = tiles.len() as u32;
        pass.dispatch(
            &self.begins_kernel,
            &tile_begins::Params { tile_count },
            tile_begins::Buffers {
                tile_sizes: self.sizes.slice_mut(),
                tile_begins: self.begins.slice_mut(),
            },
            Threads::Workgroups([1, 1, 1]),
        )?;
        pass.dispatch(
            &self.place,
            &place_pairs::Params { capacity },
            place_pairs::Buffers {
                counts: counts.slice(),
                tiles: tiles.slice(),
                ranks: intersection_ids.slice(),
                gaussian_ids: gaussian_ids.slice(),
                depth_keys: depth_keys.slice(),
                tile_begins: self.begins.slice(),
                pairs: self.pairs.slice_mut(),
            },
            Threads::Exactly([capacity, 1, 1]),
        )?;
        pass.dispatch(
            &self.sort,
            &sort_tiles::Params { tile_count },
            sort_tiles::Buffers {
                counts: counts.slice(),
                tile_begins: self.begins.slice(),
                pairs: self.pairs.slice_mut(),
                sorted_tiles: tiles.slice_mut(),
                sorted_intersections: intersection_ids.slice_mut(),
            },
            Threads::Workgroups([tile_count + 1, 1, 1]),
        )
    }
}
