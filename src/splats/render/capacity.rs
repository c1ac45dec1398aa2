//! Capacity for Gaussians, views and intersections, and its memory.

use glam::UVec2;
use nightsplat_core::camera::Camera;

use super::limits::max_tiles;
use super::{Purpose, Renderer};
use crate::{Error, Result};

impl Renderer {
    /// Reserves memory for `gaussian_count` Gaussians and the images of `cameras`, or their patches.
    ///
    /// # Errors
    /// The device is out of memory.
    pub fn reserve<'a>(
        &mut self,
        gaussian_count: usize,
        cameras: impl IntoIterator<Item = &'a Camera>,
    ) -> Result<()> {
        let mut sizes = vec![];
        for camera in cameras {
            sizes.extend(self.patches(camera).iter().map(|patch| patch.size));
        }
        self.reserve_sizes(gaussian_count, gaussian_count, sizes)
    }

    /// The same for images of these sizes; where `gaussian_count` Gaussians need more memory, for `capacity` of them.
    #[doc(hidden)]
    pub fn reserve_sizes(
        &mut self,
        gaussian_count: usize,
        capacity: usize,
        sizes: impl IntoIterator<Item = UVec2>,
    ) -> Result<()> {
        let (mut pixels, mut tiles) = (0, 0);
        for size in sizes {
            let UVec2 { x, y } = self.tiles(size);
            pixels = pixels.max(size.x as usize * size.y as usize);
            tiles = tiles.max(x as usize * y as usize);
            if x as usize * y as usize > max_tiles(&self.gpu) {
                return Err(self.too_many_tiles(size));
            }
        }
        let before = self.context_count();
        self.frame.reserve(&self.gpu, before + gaussian_count, before + capacity, pixels, tiles)?;
        self.sort.reserve_tiles(tiles)?;
        self.reserve_lamp()
    }

    /// Grows the memory to `intersections`, and half as many again where the device can bind them; never shrinks.
    ///
    /// # Errors
    /// The device is out of memory, or cannot bind that many.
    pub fn grow(&mut self, intersections: u32) -> Result<()> {
        let headroom =
            intersections.saturating_add(intersections / 2).min(self.max_intersections());
        let capacity = headroom.max(intersections);
        self.set_intersection_capacity(capacity.max(self.frame.intersection_capacity()))
    }

    /// The most intersections of a view whose gradient records the device can bind at once.
    #[doc(hidden)]
    pub fn max_intersections(&self) -> u32 {
        self.frame.max_intersections(&self.gpu)
    }

    /// Bytes per Gaussian beside its parameters.
    pub(crate) fn bytes_per_gaussian(&self) -> usize {
        self.frame.bytes_per_gaussian() + self.sort.bytes_per_gaussian()
    }

    /// The bytes of the buffers whose size follows the numbers of a view's own Gaussians and of intersections, except
    /// for those of the sorts, which are allocated with the first render.
    pub(crate) fn reserved_bytes(&self) -> usize {
        let frame = &self.frame;
        frame.splats.len().saturating_sub(self.context_count()) * frame.bytes_per_gaussian()
            + frame.lists.tiles.len() * frame.bytes_per_intersection()
    }

    /// Bytes per intersection of a view.
    pub(crate) fn bytes_per_intersection(&self) -> usize {
        self.frame.bytes_per_intersection() + self.sort.bytes_per_intersection()
    }

    /// The intersections that memory is reserved for.
    pub(crate) fn intersection_capacity(&self) -> u32 {
        self.frame.intersection_capacity()
    }

    /// Sets the capacity to exactly `intersections`.
    #[doc(hidden)]
    pub fn set_intersection_capacity(&mut self, intersections: u32) -> Result<()> {
        self.frame.set_intersection_capacity(&self.gpu, intersections)
    }

    /// Takes the memory of the sorts ahead of a recording.
    pub(super) fn reserve_sorts(&mut self) -> Result<()> {
        self.sort.reserve(self.frame.depth_keys.len(), self.frame.lists.tiles.len())
    }

    fn too_many_tiles(&self, size: UVec2) -> Error {
        let (UVec2 { x: width, y: height }, [tile_width, tile_height]) = (size, self.tile.size);
        let tiles = self.tiles(size).as_u64vec2();
        let (count, most) = (tiles.element_product(), max_tiles(&self.gpu));
        let device = &self.gpu.properties().name;
        let remedy = match self.settings.purpose {
            Purpose::Show => "draw a smaller view",
            Purpose::Train => "lower patch_pixels or take a larger tile",
        };
        Error::Usage(format!(
            "a {width}x{height} view has {count} tiles of {tile_width}x{tile_height} pixels, {device} allows {most}; \
             {remedy}"
        ))
    }
}

#[cfg(all(test, feature = "train"))]
mod tests {
    use glam::DAffine3;

    use crate::gpu::{DeviceChoice, Gpu};
    use crate::splats::device::Upload;
    use crate::splats::render::{RenderOptions, RenderSettings, Renderer};
    use nightsplat_core::camera::Camera;
    use nightsplat_models::gaussians::Gaussians;

    /// With the sorts, whose memory is allocated with the first render.
    #[test]
    fn a_render_takes_the_bytes_that_are_foreseen() {
        let gpu = Gpu::new(&DeviceChoice::Best).unwrap();
        let (gaussians, intersections) = (200_000, 300_000);
        let camera = Camera::perspective(DAffine3::IDENTITY, 0.5, [16, 8]);
        let settings = RenderSettings::default();
        let model = Gaussians::zeros(gaussians, settings.shape).upload(&gpu).unwrap();
        let mut renderer = Renderer::new(&gpu, settings).unwrap();
        let before = gpu.memory_in_use();
        renderer.reserve(gaussians, [&camera]).unwrap();
        renderer.set_intersection_capacity(intersections).unwrap();
        let options = RenderOptions { sh_degree: 3, background: [0.0; 3] };
        renderer.render_image(&model, &camera, &options).unwrap();
        assert_eq!(renderer.intersection_capacity(), intersections);
        gpu.free_unused();
        let taken = (gpu.memory_in_use() - before) as f64;
        let foreseen = gaussians * renderer.bytes_per_gaussian()
            + intersections as usize * renderer.bytes_per_intersection();
        assert!((taken / foreseen as f64 - 1.0).abs() < 0.02, "{taken} {foreseen}");
    }
}
