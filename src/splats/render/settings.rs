//! What a renderer is made for, and the tile that suits a device.

use crate::gpu::{Gpu, Tile};
use crate::splats::packed_sh::StorageFormat;
use crate::splats::scene::{Features, Shape};
use crate::{Error, Result};

/// What a renderer is specialised for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderSettings {
    /// Gaussians nearer than this are not seen, in world units.
    pub near: f32,
    /// The largest alpha of a splat on a pixel; below 1.
    pub max_alpha: f32,
    /// What the Gaussians are made of.
    pub shape: Shape,
    /// Colours are the bare SH sum, which can be negative, as in LITA-GS, instead of max(SH + 0.5, 0).
    pub raw_colors: bool,
    /// How SH coefficients above degree 0 are stored: [`Gaussians::upload`](crate::splats::scene::Gaussians::upload) leaves 32 bits,
    /// a training that is told to 16.
    pub rest: StorageFormat,
    /// The gradient of noise and illumination moves and shapes no Gaussian; that of depth and structure, which are there for
    /// it, does.
    pub detach_geometry: bool,
    /// The tile that a workgroup owns; none: what is fastest on the device.
    pub tile: Option<Tile>,
    /// The most pixels that are rendered at once; none: as many as the device can bind.
    pub patch_pixels: Option<u64>,
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self {
            near: 0.2,
            max_alpha: 0.99,
            shape: 3.into(),
            raw_colors: false,
            rest: StorageFormat::Single,
            detach_geometry: false,
            tile: None,
            patch_pixels: None,
        }
    }
}

/// The tile of a GPU, as in 3DGS, and that of a processor, whose subgroups are narrow: measured on lavapipe.
const GPU_TILE: [u32; 2] = [16, 16];
const CPU_TILE: [u32; 2] = [16, 8];
/// More channels than these take a smaller tile on a processor: its state no longer fits the registers of larger ones.
const CPU_TILE_CHANNELS: usize = 5;
const CPU_SMALL_TILE: [u32; 2] = [8, 8];

impl RenderSettings {
    /// The tile on this device, in pixels: that of these settings, else the one that was measured to be the fastest
    /// there (`Gpu::tuned_tile`), else what such devices are known to like.
    ///
    /// # Errors
    /// A subgroup's part has no whole number of rows of lanes, or more than 32.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn tile_on(&self, gpu: &Gpu) -> Result<Tile> {
        let built_in = match self.channels() {
            _ if !gpu.properties().is_cpu => GPU_TILE,
            0..=CPU_TILE_CHANNELS => CPU_TILE,
            _ => CPU_SMALL_TILE,
        };
        let tile = self.tile.or_else(|| gpu.tuned_tile(self.channels())).unwrap_or(built_in.into());
        if gpu.properties().suits_tile(tile) {
            return Ok(tile);
        }
        let lanes = gpu.properties().subgroup_size;
        let of = match tile.subgroups {
            1 => "",
            _ => " of each of 1, 2 or 4 subgroups",
        };
        let remedy = format!("1 to 32 times {lanes} pixels{of}; without `tile` the device chooses");
        let problem = format!("{tile} tiles do not suit {lanes} lanes");
        Err(Error::Usage(format!("{problem}; take a tile of {remedy}")))
    }

    /// Values per pixel of a render: RGB and the features.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn channels(&self) -> usize {
        self.shape.features.channels()
    }

    /// How many of them, from the first, move and shape the Gaussians.
    pub(super) fn shaping_channels(&self) -> u32 {
        let Features { noise, illumination, .. } = self.shape.features;
        let observing =
            if self.detach_geometry { 3 * (u32::from(noise) + u32::from(illumination)) } else { 0 };
        self.channels() as u32 - observing
    }
}
