//! The settings of a renderer, and the tile that suits a device.

use nightsplat_core::curves::SceneLaw;
use nightsplat_models::gaussians::{Features, Shape};

use crate::gpu::{Gpu, Properties, Sorting, Tile};
use crate::splats::lamp::Lamp;
use crate::splats::packed_sh::StorageFormat;
use crate::{Error, Result};

/// Specialization of a renderer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderSettings {
    /// The near plane, in world units.
    pub near: f32,
    /// The largest alpha of a splat on a pixel; below 1.
    pub max_alpha: f32,
    /// The attributes of the Gaussians.
    pub shape: Shape,
    /// Colours are the raw SH sum, which can be negative, as in LITA-GS, instead of max(SH + 0.5, 0).
    pub raw_colors: bool,
    /// Opacities are compensated for the dilation, so that a splat smaller than a pixel does not gain light: the 2D
    /// filter of Mip-Splatting. Only for a model that was trained so.
    pub antialiased: bool,
    /// Lights the colours; in units of the Gaussians. `None`: evenly lit, each Gaussian in its own colour.
    pub lamp: Option<Lamp>,
    /// What [`Target::is_photograph`](crate::Target::is_photograph) inverts.
    pub law: Option<SceneLaw>,
    /// The storage format of the SH coefficients above degree 0: 32 bits after
    /// [`Upload::upload`](crate::splats::device::Upload::upload) and by default, 16
    /// where the training configuration sets it.
    pub rest: StorageFormat,
    /// Stop-gradient: the noise and illumination channels do not affect means, scales, rotations and opacities; depth
    /// and structure, which exist to do so, do.
    pub detach_geometry: bool,
    /// What the renderer is for.
    pub purpose: Purpose,
    /// The mean depth of each pixel is trained, too: [`Renderer::forward`](crate::splats::render::Renderer::forward)
    /// keeps it as the last channel, and [`backward`](crate::splats::render::Renderer::backward) takes its gradient
    /// over alpha. Without effect where the purpose is to show.
    #[doc(hidden)]
    pub trains_depth: bool,
    /// The tile of a workgroup; `None`: the fastest on the device.
    pub tile: Option<Tile>,
    /// The most pixels that are rendered at once; `None`: as many as the device can bind.
    pub patch_pixels: Option<u64>,
    /// How intersections are sorted; `None`: as is faster on the device. To show, always as a whole.
    #[doc(hidden)]
    pub sorting: Option<Sorting>,
}

/// What a renderer is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// Renders and gradients.
    Train,
    /// Renders alone: kernels and memory for gradients are not made.
    Show,
}

impl RenderSettings {
    /// The largest alpha of a splat where none is stated.
    pub(crate) const MAX_ALPHA: f32 = 0.99;
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self {
            near: 0.2,
            max_alpha: Self::MAX_ALPHA,
            shape: 3.into(),
            raw_colors: false,
            antialiased: false,
            lamp: None,
            law: None,
            rest: StorageFormat::Single,
            detach_geometry: false,
            purpose: Purpose::Train,
            trains_depth: false,
            tile: None,
            patch_pixels: None,
            sorting: None,
        }
    }
}

/// The tile of a GPU, as in 3DGS, and that of a CPU, whose subgroups are narrow: measured on lavapipe.
const GPU_TILE: [u32; 2] = [16, 16];
const CPU_TILE: [u32; 2] = [16, 8];
/// More channels than these take a smaller tile on a CPU and with narrow subgroups, whose registers no longer hold the
/// state of a larger one.
const TILE_CHANNELS: usize = 5;
const CPU_SMALL_TILE: [u32; 2] = [8, 8];
/// Views of at most this many pixels have fewer tiles than a GPU has room for subgroups: there, several share a tile.
const SMALL_VIEW: u64 = 1 << 20;
/// So do subgroups of fewer lanes: alone, each would spill half of its state (compiled by Mesa 25 for Arc).
const WIDE_SUBGROUP: u32 = 32;
/// The tile of narrow subgroups that do not stay converged.
const SMALL_GPU_TILE: [u32; 2] = [8, 8];

/// The tile of a GPU for views of up to `pixels` pixels; `None`: of any size.
fn gpu_tile(properties: &Properties, channels: usize, pixels: Option<u64>) -> Tile {
    let is_small = pixels.is_some_and(|pixels| pixels <= SMALL_VIEW);
    let is_narrow = properties.subgroup_size < WIDE_SUBGROUP;
    let divisor = if is_narrow && channels > TILE_CHANNELS { 2 } else { 1 };
    let of = |[width, height]: [u32; 2], subgroups| Tile {
        subgroups,
        ..[width, height / divisor].into()
    };
    let shared = of(GPU_TILE, 4);
    match properties.suits_tile(shared) {
        true if is_small || is_narrow => shared,
        false if is_narrow => of(SMALL_GPU_TILE, 1),
        _ => GPU_TILE.into(),
    }
}

impl RenderSettings {
    /// `RenderSettings::tile_up_to` for views of any size.
    #[doc(hidden)]
    pub fn tile_on(&self, gpu: &Gpu) -> Result<Tile> {
        self.tile_up_to(gpu, None)
    }

    /// The tile on this device, in pixels: that of these settings, else the one that was measured to be the fastest
    /// (`Gpu::tuned_tile`), else the default for such devices and views of up to `pixels` pixels.
    pub(super) fn tile_up_to(&self, gpu: &Gpu, pixels: Option<u64>) -> Result<Tile> {
        let built_in = match self.channels() {
            _ if !gpu.properties().is_cpu => gpu_tile(gpu.properties(), self.channels(), pixels),
            0..=TILE_CHANNELS => CPU_TILE.into(),
            _ => CPU_SMALL_TILE.into(),
        };
        let tuned = || gpu.tuned_tile(self.channels()).map(|tuned| tuned.tile);
        let tile = self.tile.or_else(tuned).unwrap_or(built_in);
        if gpu.properties().suits_tile(tile) {
            return Ok(tile);
        }
        let lanes = gpu.properties().subgroup_size;
        let of = match tile.subgroups {
            1 => "",
            _ => " of each of 1, 2 or 4 subgroups",
        };
        let of = match tile.backward {
            None => of.to_owned(),
            Some(_) => {
                format!("{of}, segments of a multiple of {lanes} splats, and sums by shuffles (0)")
            }
        };
        let remedy = format!("1 to 32 times {lanes} pixels{of}; without `tile` the device chooses");
        let problem = format!("{tile} tiles do not suit {lanes} lanes");
        Err(Error::Usage(format!("{problem}; take a tile of {remedy}")))
    }

    /// The sort on this device: that of these settings, else the one that was measured to be faster. A draw without
    /// gradients may leave out the farthest intersections of the whole view.
    pub(super) fn sorting_on(&self, gpu: &Gpu) -> Sorting {
        let tuned = || Some(gpu.tuned_tile(self.channels())?.sorting);
        match self.purpose {
            Purpose::Show => Sorting::Whole,
            Purpose::Train => self.sorting.or_else(tuned).unwrap_or_default(),
        }
    }

    /// Values per pixel of a render: RGB and the features.
    #[doc(hidden)]
    pub fn channels(&self) -> usize {
        self.shape.features.channels()
    }

    /// Whether the last channel of a training render is the depth.
    pub(super) fn keeps_depth(&self) -> bool {
        self.trains_depth && self.purpose == Purpose::Train
    }

    /// Values per pixel of a training render: [`Self::channels`], and the depth if that is trained.
    pub(crate) fn trained_channels(&self) -> usize {
        self.channels() + usize::from(self.keeps_depth())
    }

    /// The leading channels whose gradients reach the geometry.
    pub(super) fn shaping_channels(&self) -> u32 {
        let Features { noise, illumination, .. } = self.shape.features;
        let observing =
            if self.detach_geometry { 3 * (u32::from(noise) + u32::from(illumination)) } else { 0 };
        self.channels() as u32 - observing
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn subgroups_share_the_tiles_of_small_views_on_a_gpu_that_keeps_them_together() {
        let shared = Tile { subgroups: 4, ..[16, 16].into() };
        let gpu = Properties {
            subgroup_size: 32,
            has_uniform_subgroup_control_flow: true,
            ..Properties::of_a_test()
        };
        assert_eq!(gpu_tile(&gpu, 3, Some(500 * 375)), shared);
        assert_eq!(gpu_tile(&gpu, 3, Some(1920 * 1080)), [16, 16].into());
        assert_eq!(gpu_tile(&gpu, 3, None), [16, 16].into());
        // A part would have fewer pixels than a subgroup has lanes.
        let wide = Properties { subgroup_size: 128, ..gpu.clone() };
        assert_eq!(gpu_tile(&wide, 3, Some(500 * 375)), [16, 16].into());
        let parting = Properties { has_uniform_subgroup_control_flow: false, ..gpu.clone() };
        assert_eq!(gpu_tile(&parting, 3, Some(500 * 375)), [16, 16].into());
        let narrow = Properties { subgroup_size: 16, ..gpu };
        assert_eq!(gpu_tile(&narrow, 3, None), shared);
        let both = Properties { subgroup_size: 16, ..parting };
        assert_eq!(gpu_tile(&both, 3, None), [8, 8].into());
    }
}
