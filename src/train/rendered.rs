//! What a model shows of a view: its colours, and what its networks make of them.

use glam::UVec2;

use super::Networks;
use crate::Result;
use crate::camera::Camera;
use crate::gpu::Buffer;
use crate::image::Image;
use crate::render::{RenderOptions, Renderer};

/// What a model shows of a view.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// R_0: the Gaussians' colours.
    pub colors: Image,
    /// R_K, where the model has a denoiser.
    pub denoised: Option<Image>,
}

impl Rendered {
    /// Renders what `camera` sees of `gaussians`, (columns x Gaussians), and what the networks make of it.
    ///
    /// # Errors
    /// As [`Renderer::render_image`]; the device is out of memory for the networks.
    pub fn new(
        renderer: &mut Renderer,
        gaussians: &Buffer<f32>,
        camera: &Camera,
        options: &RenderOptions,
        networks: Option<&mut Networks>,
    ) -> Result<Self> {
        let colors = renderer.render_image(gaussians, camera, options)?;
        let size = UVec2::new(camera.width, camera.height);
        let denoised = match networks {
            Some(networks) => networks.denoised_image(renderer.render(), size)?,
            None => None,
        };
        Ok(Self { colors, denoised })
    }

    /// What the model is scored on: R_K, or R_0 where there is no denoiser.
    pub fn output(&self) -> &Image {
        self.denoised.as_ref().unwrap_or(&self.colors)
    }
}

/// A picture that no denoiser has seen.
impl From<Image> for Rendered {
    fn from(colors: Image) -> Self {
        Self { colors, denoised: None }
    }
}
