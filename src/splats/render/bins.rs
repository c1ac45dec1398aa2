//! From projected splats to the sorted list of each tile.

use super::buffers::RANKS_PER_PARTITION;
use super::{KernelView, Lists, Renderer};
use crate::Result;
use crate::gpu::{Gpu, Recorder, Sorting, Threads};
use crate::kernels::project::DEPTH_BITS;
use crate::kernels::{emit, order_counts};
use crate::splats::sort::{Count, RadixSort, TileSort, UnsortedTiles};

/// The sort of the intersections by tile and depth.
#[derive(Debug)]
#[expect(clippy::large_enum_variant, reason = "there is one for each renderer")]
pub(super) enum Sort {
    /// All Gaussians by depth, then all intersections by tile.
    Whole { by_depth: RadixSort, by_tile: RadixSort },
    /// Each tile by itself.
    Tiles(TileSort),
}

impl Sort {
    /// With memory for nothing yet.
    pub(super) fn new(gpu: &Gpu, sorting: Sorting) -> Result<Self> {
        match sorting {
            Sorting::Whole => {
                let by_depth = RadixSort::new(gpu, 0)?;
                Ok(Self::Whole { by_tile: by_depth.another()?, by_depth })
            }
            Sorting::Tiles => Ok(Self::Tiles(TileSort::new(gpu)?)),
        }
    }

    pub(super) fn bytes_per_gaussian(&self) -> usize {
        match self {
            Self::Whole { by_depth, .. } => by_depth.bytes_per_item(),
            Self::Tiles(_) => 0,
        }
    }

    pub(super) fn bytes_per_intersection(&self) -> usize {
        match self {
            Self::Whole { by_tile, .. } => by_tile.bytes_per_item(),
            Self::Tiles(_) => TileSort::bytes_per_item(),
        }
    }

    /// Takes memory for views of up to `tiles` tiles, between recordings.
    pub(super) fn reserve_tiles(&mut self, tiles: usize) -> Result<()> {
        match self {
            Self::Whole { .. } => Ok(()),
            Self::Tiles(sort) => sort.reserve_tiles(tiles),
        }
    }

    /// Takes the rest of its memory ahead of a recording.
    pub(super) fn reserve(&mut self, gaussians: usize, intersections: usize) -> Result<()> {
        match self {
            Self::Whole { by_depth, by_tile } => {
                by_depth.reserve(gaussians)?;
                by_tile.reserve(intersections)
            }
            Self::Tiles(sort) => sort.reserve(intersections),
        }
    }
}

impl Renderer {
    /// From projected splats to the sorted list of each tile, front to back.
    pub(super) fn record_bins(
        &mut self,
        pass: &mut Recorder<'_>,
        gaussian_count: u32,
        view: &KernelView<'_>,
        capacity: Option<u32>,
    ) -> Result<()> {
        let tile_count = view.tile_count();
        let Self { frame, sort, .. } = self;
        if let (Sort::Whole { by_depth, .. }, false) = (&mut *sort, view.order.is_kept()) {
            let all = Count { counts: &frame.gaussian_counts, index: 0 };
            by_depth.record(pass, all, &mut frame.depth_keys, &mut frame.ids, DEPTH_BITS)?;
        }
        pass.dispatch(
            &self.order_counts,
            &order_counts::Params {
                gaussian_count,
                capacity: capacity.unwrap_or(frame.intersection_capacity()),
                truncates: capacity.is_some().into(),
            },
            order_counts::Buffers {
                sorted_ids: frame.ids.slice(),
                tile_counts: frame.tile_counts.slice(),
                intersection_offsets: frame.intersection_offsets.slice_mut(),
                sums: frame.sums.slice_mut(),
                counts: frame.lists.counts.slice_mut(),
                status: frame.status.slice_mut(),
                arrivals: frame.arrivals.slice_mut(),
            },
            Threads::Workgroups([gaussian_count.div_ceil(RANKS_PER_PARTITION).max(1), 1, 1]),
        )?;
        pass.dispatch(
            &self.emit,
            &emit::Params { size: view.size, gaussian_count, tile_columns: view.tiles.x },
            emit::Buffers {
                counts: frame.lists.counts.slice(),
                sorted_ids: frame.ids.slice(),
                tile_counts: frame.tile_counts.slice(),
                intersection_offsets: frame.intersection_offsets.slice(),
                sums: frame.sums.slice(),
                splats: frame.splats.slice(),
                tiles: frame.lists.tiles.slice_mut(),
                intersection_ids: frame.lists.intersection_ids.slice_mut(),
                gaussian_ids: frame.lists.gaussian_ids.slice_mut(),
                intersection_ranges: frame.lists.intersection_ranges.slice_mut(),
                tile_sizes: match sort {
                    Sort::Whole { .. } => frame.no_sizes.slice_mut(),
                    Sort::Tiles(tiles) => tiles.sizes.slice_mut(),
                },
            },
            Threads::Exactly([gaussian_count, 1, 1]),
        )?;
        let Lists { counts, tiles, intersection_ids, gaussian_ids, .. } = &mut frame.lists;
        match sort {
            Sort::Whole { by_tile, .. } => {
                let intersections = Count { counts, index: 0 };
                // One value more than there are tiles: padding sorts last.
                let bits = u32::BITS - tile_count.leading_zeros();
                by_tile.record(pass, intersections, tiles, intersection_ids, bits)
            }
            Sort::Tiles(sort) => {
                let depth_keys = &frame.depth_keys;
                let unsorted =
                    UnsortedTiles { counts, gaussian_ids, depth_keys, tiles, intersection_ids };
                sort.record(pass, tile_count, unsorted)
            }
        }
    }
}
