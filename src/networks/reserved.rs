//! The memory that a network has reserved for views.

use glam::UVec2;

use super::{check_images, out_of_turn, pixel_count};
use crate::Result;
use crate::gpu::Buffer;

/// The sizes that determine the lengths of a network's buffers.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Extent {
    pub(super) pixels: usize,
    /// Partial sums of the gradient of the largest layer.
    pub(super) partials: usize,
    /// Size of a packed feature map; 0 in single precision.
    pub(super) packed: usize,
}

impl Extent {
    pub(super) fn fits(self, reserved: Self) -> bool {
        self.pixels <= reserved.pixels
            && self.partials <= reserved.partials
            && self.packed <= reserved.packed
    }

    pub(super) fn max(self, other: Self) -> Self {
        Self {
            pixels: self.pixels.max(other.pixels),
            partials: self.partials.max(other.partials),
            packed: self.packed.max(other.packed),
        }
    }
}

/// The memory of one view, `M`, and the last pass recorded in it.
#[derive(Debug)]
pub(super) struct Reserved<M> {
    network: &'static str,
    extent: Extent,
    pub(super) memory: M,
    /// The size of the last forward pass.
    pub(super) recorded: Option<UVec2>,
}

impl<M> Reserved<M> {
    /// Reserves nothing yet.
    pub(super) fn new(
        network: &'static str,
        allocate: impl Fn(Extent) -> Result<M>,
    ) -> Result<Self> {
        let extent = Extent::default();
        Ok(Self { network, extent, memory: allocate(extent)?, recorded: None })
    }

    /// Allocates for views up to `needed`; it never shrinks.
    pub(super) fn grow(
        &mut self,
        needed: Extent,
        allocate: impl Fn(Extent) -> Result<M>,
    ) -> Result<()> {
        if needed.fits(self.extent) {
            return Ok(());
        }
        // The old memory is freed first: both together may not fit.
        self.recorded = None;
        let extent = needed.max(std::mem::take(&mut self.extent));
        self.memory = allocate(Extent::default())?;
        self.memory = allocate(extent)?;
        self.extent = extent;
        Ok(())
    }

    /// Checks a forward pass of a view that needs this extent; returns its number of pixels.
    pub(super) fn check_forward(
        &self,
        size: UVec2,
        needed: Extent,
        images: [&Buffer<f32>; 2],
    ) -> Result<u32> {
        let pixels = pixel_count(size)?;
        if !needed.fits(self.extent) {
            return Err(out_of_turn(self.network, size, "reserve memory for that size first"));
        }
        check_images(pixels, images)?;
        Ok(pixels as u32)
    }

    /// Checks a backward pass, which uses up its forward pass; returns the number of pixels.
    pub(super) fn check_backward(&mut self, size: UVec2, images: [&Buffer<f32>; 5]) -> Result<u32> {
        let pixels = pixel_count(size)?;
        check_images(pixels, images)?;
        if self.recorded.take() != Some(size) {
            let remedy = "each backward pass needs its own preceding forward pass";
            return Err(out_of_turn(self.network, size, remedy));
        }
        Ok(pixels as u32)
    }
}
