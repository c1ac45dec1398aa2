//! The sorted intersections of a view.

use glam::UVec2;

use crate::Result;
use crate::gpu::{Buffer, Gpu};

/// The intersections of a view, sorted by tile and depth.
#[derive(Debug)]
#[allow(missing_docs, reason = "each is declared in the kernels that write and read it")]
pub struct Lists {
    /// `[0]`: the number of intersections
    pub counts: Buffer<u32>,
    pub tiles: Buffer<u32>,
    pub intersection_ids: Buffer<u32>,
    pub gaussian_ids: Buffer<u32>,
    /// (Gaussians)
    pub intersection_ranges: Buffer<UVec2>,
}

impl Lists {
    pub(super) const BYTES_PER_INTERSECTION: usize = 3 * size_of::<u32>();

    /// With memory for this many Gaussians and intersections.
    pub(super) fn new(gpu: &Gpu, gaussians: usize, intersections: usize) -> Result<Self> {
        Ok(Self {
            counts: gpu.zeros("counts", 1)?,
            tiles: gpu.uninit("tiles", intersections)?,
            intersection_ids: gpu.uninit("intersection_ids", intersections)?,
            gaussian_ids: gpu.uninit("gaussian_ids", intersections)?,
            intersection_ranges: gpu.uninit("intersection_ranges", gaussians)?,
        })
    }

    /// Other memory for this many intersections; where memory is out, it is as it was.
    pub(super) fn allocate(&mut self, gpu: &Gpu, intersections: usize) -> Result<()> {
        let tiles = gpu.uninit("tiles", intersections)?;
        let intersection_ids = gpu.uninit("intersection_ids", intersections)?;
        self.gaussian_ids = gpu.uninit("gaussian_ids", intersections)?;
        (self.tiles, self.intersection_ids) = (tiles, intersection_ids);
        Ok(())
    }
}
