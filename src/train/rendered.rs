//! What a model shows of a view: its colours, and what its networks make of them.

use super::Networks;
use crate::Result;
use crate::camera::{Camera, Patch};
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
    /// Renders what `camera` sees of so many `gaussians`, (columns x Gaussians), and what the networks make of it: patch by
    /// patch where the device takes no more at once. A denoiser's norms then look at each patch.
    ///
    /// # Errors
    /// As [`Renderer::render_image`]; the device is out of memory for the view or the networks.
    pub fn new(
        renderer: &mut Renderer,
        (gaussians, count): (&Buffer<f32>, usize),
        camera: &Camera,
        options: &RenderOptions,
        networks: Option<&mut Networks>,
    ) -> Result<Self> {
        let Some(networks) = networks.filter(|networks| networks.has_denoiser()) else {
            renderer.reserve(count, [camera])?;
            return Ok(renderer.render_image(gaussians, camera, options)?.into());
        };
        let (whole, margin) = (Patch::from(camera), networks.margin());
        let patches = renderer.patches_with_margin(camera, margin, |size| networks.fits(size));
        let mut colors = Image::filled(camera.width, camera.height, [0.0; 3]);
        let mut denoised = colors.clone();
        for patch in patches {
            let around = patch.with_margin(margin);
            renderer.reserve_with_headroom([count; 2], [around.size])?;
            let channels = renderer.render_patch(gaussians, &around, options)?;
            patch.paste((&around, &channels), (&whole, &mut colors.data));
            let own = networks.denoised_image(&channels, around.size)?;
            patch.paste((&around, &own.data), (&whole, &mut denoised.data));
        }
        Ok(Self { colors, denoised: Some(denoised) })
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
