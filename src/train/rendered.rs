//! The render of a view: colours, and the output of the networks.

use nightsplat_core::camera::{Camera, Patch};
use nightsplat_photographs::image::Image;

use super::networks::Networks;
use crate::Result;
use crate::splats::device::{GaussianSlice, Layout};
use crate::splats::render::{RenderOptions, Renderer};

/// The render of a view.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// R_0: the Gaussians' colours.
    pub colors: Image,
    /// R_K, if the model has a denoiser.
    pub denoised: Option<Image>,
    /// The residual transmittance of each pixel, 0 to 1, (H, W); `None` for an image that is not a render.
    pub transmittances: Option<Vec<f32>>,
}

impl Rendered {
    /// Renders `gaussians` from `camera` and applies the networks; in patches if the view exceeds the device, with a
    /// denoiser's norms over each patch.
    #[doc(hidden)]
    pub fn new<'a>(
        renderer: &mut Renderer,
        gaussians: impl Into<GaussianSlice<'a>>,
        camera: &Camera,
        options: &RenderOptions,
        networks: Option<&mut Networks>,
    ) -> Result<Self> {
        let gaussians = gaussians.into();
        let Layout { count, capacity, .. } = gaussians.layout;
        let Some(networks) = networks.filter(|networks| networks.has_denoiser()) else {
            renderer.reserve(count, [camera])?;
            let planes = renderer.render_planes(gaussians, camera, options)?;
            return Ok(Self::of_planes(camera, planes));
        };
        let (whole, margin) = (Patch::from(camera), networks.margin());
        let patches = renderer.patches_with_margin(camera, margin, |size| networks.fits(size));
        let mut denoised = Image::filled(camera.width, camera.height, [0.0; 3]);
        let mut planes = vec![];
        for patch in patches {
            let around = patch.with_margin(margin);
            renderer.reserve_sizes(count, capacity, [around.size])?;
            let planes_of_part = renderer.render_patch(gaussians, &around, options)?;
            planes.resize(planes_of_part.len() / around.pixel_count() * whole.pixel_count(), 0.0);
            patch.paste(&around, &planes_of_part, &whole, &mut planes);
            let channels = &planes_of_part[..planes_of_part.len() - around.pixel_count()];
            let denoised_part = networks.denoised_image(channels, around.size)?;
            patch.paste(&around, &denoised_part.data, &whole, &mut denoised.data);
        }
        Ok(Self { denoised: Some(denoised), ..Self::of_planes(camera, planes) })
    }

    /// The planes of [`Renderer::render_planes`], without a denoiser.
    fn of_planes(&Camera { width, height, .. }: &Camera, mut planes: Vec<f32>) -> Self {
        let pixels = width as usize * height as usize;
        let transmittances = planes.split_off(planes.len() - pixels);
        planes.truncate(3 * pixels);
        let colors = Image { width, height, data: planes };
        Self { colors, denoised: None, transmittances: Some(transmittances) }
    }

    /// The image that is scored: R_K, or R_0 without a denoiser.
    pub fn output(&self) -> &Image {
        self.denoised.as_ref().unwrap_or(&self.colors)
    }
}

/// An image that is not a render, such as a photograph.
impl From<Image> for Rendered {
    fn from(colors: Image) -> Self {
        Self { colors, denoised: None, transmittances: None }
    }
}
