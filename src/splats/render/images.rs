//! Renders to the host: the whole view if the device can, else patch by patch.

use glam::UVec2;
use nightsplat_core::camera::{Camera, Patch};
use nightsplat_core::image::Image;

use super::{DepthChannel, RenderOptions, RenderSettings, Renderer, Status};
use crate::Result;
use crate::splats::device::GaussianSlice;

impl Renderer {
    /// The patches in which a view is rendered: the whole view where the device can, else patches that fit.
    #[doc(hidden)]
    pub fn patches(&self, camera: &Camera) -> Vec<Patch> {
        self.patches_with_margin(camera, 0, |_| true)
    }

    /// The same with a margin of neighbouring pixels around each patch; the whole view must satisfy `fits` too.
    pub(crate) fn patches_with_margin(
        &self,
        camera: &Camera,
        margin: u32,
        suits: impl Fn(UVec2) -> bool,
    ) -> Vec<Patch> {
        let settings = RenderSettings { tile: Some(self.tile), ..self.settings };
        let whole = Patch::from(camera).size;
        camera.patches(|size| {
            let around = size.saturating_add(UVec2::splat(2 * margin)).min(whole);
            let is_small = settings.takes_at_once(&self.gpu, size);
            is_small && settings.suits(&self.gpu, around) && suits(around)
        })
    }

    /// Renders to the host; grows the memory as the view needs.
    ///
    /// # Errors
    /// The Gaussians do not match the settings, they or the image exceed what was reserved, or the device is out of
    /// memory or lost.
    pub fn render_image<'a>(
        &mut self,
        gaussians: impl Into<GaussianSlice<'a>>,
        camera: &Camera,
        options: &RenderOptions,
    ) -> Result<Image> {
        let mut data = self.render_planes(gaussians, camera, options)?;
        let Camera { width, height, .. } = *camera;
        data.truncate(3 * width as usize * height as usize);
        Ok(Image { width, height, data })
    }

    /// Renders all channels to the host, (channels, H, W), patch by patch where the device cannot at once; grows the
    /// memory as the view needs.
    ///
    /// # Errors
    /// As [`Renderer::render_image`].
    pub fn render_channels<'a>(
        &mut self,
        gaussians: impl Into<GaussianSlice<'a>>,
        camera: &Camera,
        options: &RenderOptions,
    ) -> Result<Vec<f32>> {
        let mut planes = self.render_planes(gaussians, camera, options)?;
        planes.truncate(self.settings.channels() * Patch::from(camera).pixel_count());
        Ok(planes)
    }

    /// As [`Renderer::render_channels`], with the transmittance as the last channel, (channels + 1, H, W).
    #[doc(hidden)]
    pub fn render_planes<'a>(
        &mut self,
        gaussians: impl Into<GaussianSlice<'a>>,
        camera: &Camera,
        options: &RenderOptions,
    ) -> Result<Vec<f32>> {
        let (gaussians, patches) = (gaussians.into(), self.patches(camera));
        if let [whole] = &patches[..] {
            return self.render_patch(gaussians, whole, options);
        }
        self.render_parts(gaussians, &Patch::from(camera), &patches, options)
    }

    fn render_parts(
        &mut self,
        gaussians: GaussianSlice<'_>,
        whole: &Patch,
        parts: &[Patch],
        options: &RenderOptions,
    ) -> Result<Vec<f32>> {
        let mut data = vec![0.0; (self.settings.channels() + 1) * whole.pixel_count()];
        for part in parts {
            let planes = self.render_patch(gaussians, part, options)?;
            part.paste(part, &planes, whole, &mut data);
        }
        Ok(data)
    }

    /// The number of intersections of a patch, whether it exceeds the capacity or not.
    pub(crate) fn count_intersections(
        &mut self,
        gaussians: GaussianSlice<'_>,
        patch: &Patch,
    ) -> Result<u32> {
        let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
        Ok(self.try_render(gaussians, patch, &options, None)?.intersections)
    }

    /// Renders once and returns the status; all flags are cleared.
    fn try_render(
        &mut self,
        gaussians: GaussianSlice<'_>,
        patch: &Patch,
        options: &RenderOptions,
        depths: Option<DepthChannel>,
    ) -> Result<Status> {
        let status = self.gpu.clone().run("render", |pass| {
            self.record_forward(pass, gaussians, *patch, options, depths)?;
            let status = pass.download(&self.frame.status)?;
            self.clear_status(pass);
            Ok(status)
        })?;
        Ok(Status::from_words(&status.wait()?))
    }

    /// Renders a patch on the device, and grows the memory as it needs. Returns the patch's halves instead where the
    /// device cannot bind all its intersections.
    pub(super) fn render_or_halve(
        &mut self,
        gaussians: GaussianSlice<'_>,
        patch: &Patch,
        options: &RenderOptions,
        depths: Option<DepthChannel>,
    ) -> Result<Option<[Patch; 2]>> {
        loop {
            let status = self.try_render(gaussians, patch, options, depths)?;
            if status.splats_per_tile > 0 {
                let UVec2 { x: width, y: height } = patch.size;
                return Err(self.too_many_splats(
                    format!("a {width}x{height} render"),
                    status.splats_per_tile,
                ));
            }
            if !status.overflowed {
                return Ok(None);
            }
            let is_too_much = status.intersections > self.max_intersections();
            if let Some(halves) = patch.halves().filter(|_| is_too_much) {
                return Ok(Some(halves));
            }
            self.grow(status.intersections)?;
        }
    }

    /// All channels of one patch, then its [`Renderer::transmittances`], (channels + 1, h, w); in two halves where the
    /// device cannot bind all its intersections.
    pub(crate) fn render_patch<'a>(
        &mut self,
        gaussians: impl Into<GaussianSlice<'a>>,
        patch: &Patch,
        options: &RenderOptions,
    ) -> Result<Vec<f32>> {
        let gaussians = gaussians.into();
        if let Some(halves) = self.render_or_halve(gaussians, patch, options, None)? {
            return self.render_parts(gaussians, patch, &halves, options);
        }
        self.read_planes(patch)
    }

    /// The planes of the patch that was rendered last.
    pub(super) fn read_planes(&self, patch: &Patch) -> Result<Vec<f32>> {
        let mut planes = self.gpu.read(&self.frame.render)?;
        planes.truncate(self.settings.channels() * patch.pixel_count());
        let transmittances = self.gpu.read(&self.frame.transmittances)?;
        planes.extend_from_slice(&transmittances[..patch.pixel_count()]);
        Ok(planes)
    }
}
