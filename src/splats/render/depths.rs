//! The depth of a view, to the host.

use nightsplat_core::camera::{Camera, Patch};

use super::{DepthChannel, ProjectionKind, RenderOptions, Renderer};
use crate::Result;
use crate::kernels::blend_forward::DEPTH_MEDIAN;
use crate::kernels::pack_pixels::NOTHING_SEEN;
use crate::splats::camera::model_number;
use crate::splats::device::DeviceGaussians;

/// The median depth, of everything in view.
const MEDIAN: DepthChannel = DepthChannel { kind: DEPTH_MEDIAN, has_limits: false };

impl Renderer {
    /// The median depth of each pixel, (H, W), world units: the depth in the view of the splat at which the
    /// transmittance passes 1/2; infinite where it does not.
    pub(crate) fn render_depths(
        &mut self,
        gaussians: &DeviceGaussians,
        camera: &Camera,
        options: &RenderOptions,
    ) -> Result<Vec<f32>> {
        self.frame.set_channels(&self.gpu, self.settings.channels() + 1)?;
        self.reserve(gaussians.layout.count, [camera])?;
        let camera_model = model_number(&camera.model);
        self.build_projections(ProjectionKind {
            camera_model,
            view_depths: true,
            instances: None,
            shares_sort: false,
        })?;
        self.build_blending(true)?;
        let whole = Patch::from(camera);
        let mut depths = vec![f32::INFINITY; whole.pixel_count()];
        let mut patches = self.patches(camera);
        while let Some(patch) = patches.pop() {
            let halves = self.render_or_halve(gaussians.slice(), &patch, options, Some(MEDIAN))?;
            if let Some(halves) = halves {
                patches.extend(halves);
                continue;
            }
            let planes = self.gpu.read(&self.frame.render)?;
            let plane = &planes[self.settings.channels() * patch.pixel_count()..];
            let is_seen = |depth: f32| f64::from(depth) < NOTHING_SEEN;
            let plane: Vec<f32> = plane[..patch.pixel_count()]
                .iter()
                .map(|&depth| if is_seen(depth) { depth } else { f32::INFINITY })
                .collect();
            patch.paste(&patch, &plane, &whole, &mut depths);
        }
        Ok(depths)
    }
}
