//! What the training views say of each Gaussian.
//!
//! A render is linear in the alpha of a Gaussian on a pixel, so that removing Gaussian i alone changes the squared
//! error of a view, |render - target|^2, by
//!
//! ```text
//! gain(i) = |d(i)|^2 - 2 <render - target, d(i)>,    d(i) = opacity dR / d opacity
//! ```
//!
//! with d(i) what it adds to the render. The backward pass of the rasteriser gives the product exactly, for all
//! Gaussians at once. For the square it is given images of random signs: the expectation of <signs, d>^2 is |d|^2
//! (Hutchinson's estimator). Its gradient with respect to a white colour is the weight of a Gaussian in the view.

use glam::Vec3;
use nightsplat_core::camera::{Camera, Patch};
use nightsplat_core::random::Stream;
use nightsplat_models::edit::floaters::Evidence;
use nightsplat_models::edit::placement::Placement;
use nightsplat_models::gaussians::{
    Attribute, COLOR_CHANNELS, Features, Gaussians, ModelFacts, SH_C0,
};
use nightsplat_photographs::dataset::View;
use nightsplat_photographs::image::Image;

use super::capture::ModelPhotographs;
use crate::Result;
use crate::splats::device::{DeviceGaussians, Upload};
use crate::splats::model::Model;
use crate::splats::render::{RenderOptions, RenderSettings, Renderer, ViewGradients};
use nightsplat_photographs::exposures::Affine;

/// Images of signs per view.
const PROBES: usize = 2;

/// A model on the device in the frame of its dataset.
pub(super) struct Measured<'a> {
    capture: &'a ModelPhotographs,
    placement: Placement,
    gaussians: Gaussians,
    facts: ModelFacts,
}

impl<'a> Measured<'a> {
    pub(super) fn new(
        capture: &'a ModelPhotographs,
        placement: Placement,
        gaussians: &Gaussians,
        facts: &ModelFacts,
    ) -> Self {
        // Networks act on renders; what a Gaussian adds is measured before them.
        let gaussians = gaussians.with_features(Features::NONE);
        Self { capture, placement, gaussians, facts: facts.clone() }
    }

    fn renderer(&self, gaussians: Gaussians) -> Result<(DeviceGaussians, Renderer)> {
        let ModelPhotographs { gpu, config, .. } = self.capture;
        let frame = self.placement.frame(&config.frame.unwrap_or_default());
        let near = self.facts.near.or(config.facts(&frame).near);
        let model = Model::of_shown(gaussians, &ModelFacts { near, ..self.facts.clone() });
        let settings = RenderSettings {
            patch_pixels: config.patch_pixels,
            near: (f64::from(model.near) * frame.scale) as f32,
            ..model.render_settings()
        };
        Ok((model.gaussians.to_frame(&frame).upload(gpu)?, Renderer::new(gpu, settings)?))
    }

    fn camera(&self, camera: &Camera) -> Camera {
        let frame = self.placement.frame(&self.capture.config.frame.unwrap_or_default());
        frame.camera(&self.placement.camera(camera))
    }

    /// The rendered weight of each Gaussian, (views, count).
    fn weights(&self, mut take: impl FnMut(&[f64])) -> Result<()> {
        let mut white = self.gaussians.with_sh_degree(0);
        white.dc_mut().fill(Vec3::ZERO);
        let (gaussians, mut renderer) = self.renderer(white)?;
        let mut gradients = ViewGradients::new(&self.capture.gpu, &gaussians, Attribute::Dc)?;
        let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
        for view in self.capture.views() {
            let mut weights = vec![0.0; self.gaussians.count];
            let mask =
                view.mask.as_ref().map(|mask| mask.resized(view.camera.width, view.camera.height));
            renderer.view_gradients(
                &gaussians,
                &self.camera(&view.camera),
                &options,
                &mut gradients,
                |patch, _| {
                    let mut d_render = vec![0.0; COLOR_CHANNELS * patch.pixel_count()];
                    match &mask {
                        Some(mask) => {
                            let mask_weights = patch.cut(&mask.weights);
                            d_render[..mask_weights.len()].copy_from_slice(&mask_weights);
                        }
                        None => d_render[..patch.pixel_count()].fill(1.0),
                    }
                    vec![d_render]
                },
                |_, dc| {
                    let weights_of_gaussians =
                        dc.chunks_exact(3).map(|dc| f64::from(dc[0] / SH_C0));
                    weights
                        .iter_mut()
                        .zip(weights_of_gaussians)
                        .for_each(|(sum, weights_of_gaussians)| *sum += weights_of_gaussians);
                },
            )?;
            take(&weights);
        }
        Ok(())
    }

    /// The rendered weight of each Gaussian over all training views, pixels.
    pub(super) fn summed_weights(&self) -> Result<Vec<f64>> {
        let mut sums = vec![0.0; self.gaussians.count];
        self.weights(|weights| {
            sums.iter_mut().zip(weights).for_each(|(sum, weight)| *sum += weight);
        })?;
        Ok(sums)
    }

    pub(super) fn evidence(&self, targets: &[Option<Image>]) -> Result<Evidence> {
        let zeros = || vec![0.0; self.gaussians.count];
        let mut evidence = Evidence { product: zeros(), square: zeros(), error: 0.0 };
        let (mut errors, mut values) = (0.0, 0);
        let adjusts = self.capture.adjusts;
        let (gaussians, mut renderer) = self.renderer(self.gaussians.clone())?;
        let mut gradients =
            ViewGradients::new(&self.capture.gpu, &gaussians, Attribute::RawOpacities)?;
        let options =
            RenderOptions { sh_degree: self.gaussians.shape.sh_degree, background: [0.0; 3] };
        // From the gradient of the raw opacity to that of its logarithm.
        let scales: Vec<f64> =
            self.gaussians.raw_opacities().iter().map(|&raw| 1.0 + f64::from(raw).exp()).collect();
        for (number, (view, target)) in (0..).zip(self.capture.views().zip(targets)) {
            let Some(target) = target else { continue };
            let (mut product, mut square) = (zeros(), zeros());
            let signs = Stream::new(0x5157, number);
            renderer.view_gradients(
                &gaussians,
                &self.camera(&view.camera),
                &options,
                &mut gradients,
                |patch, planes| {
                    let d_renders = d_renders(view, target, patch, planes, signs, adjusts);
                    let squares = d_renders[0].iter().map(|d| f64::from(d / 2.0).powi(2));
                    errors += squares.sum::<f64>();
                    values += d_renders[0].len();
                    d_renders
                },
                |index, raw| {
                    for ((derivative, scale), (product, square)) in
                        raw.iter().zip(&scales).zip(product.iter_mut().zip(&mut square))
                    {
                        let derivative = f64::from(*derivative) * scale;
                        match index {
                            0 => *product += derivative,
                            _ => *square += derivative * derivative / PROBES as f64,
                        }
                    }
                },
            )?;
            let sums = evidence.product.iter_mut().zip(&mut evidence.square);
            for ((sum_product, sum_square), (product, square)) in
                sums.zip(product.iter().zip(&square))
            {
                *sum_product += product;
                *sum_square += square;
            }
        }
        evidence.error = errors / (values as f64).max(1.0);
        Ok(evidence)
    }
}

/// The gradient of the squared error with respect to the render of a patch, and images of signs; without masked
/// pixels. With `adjusts`, the target takes the gain and bias of the render.
fn d_renders(
    view: &View,
    target: &Image,
    patch: &Patch,
    planes: &[f32],
    signs: Stream,
    adjusts: bool,
) -> Vec<Vec<f32>> {
    let pixels = patch.pixel_count();
    let mask = view.mask.as_ref().map(|mask| mask.resized(view.camera.width, view.camera.height));
    let mask = mask.as_ref().map(|mask| patch.cut(&mask.weights));
    let counts = |at: usize| mask.as_ref().map_or(1.0, |mask| mask[at % pixels]);
    let colors = &planes[..COLOR_CHANNELS * pixels];
    let image =
        |data: &[f32]| Image { width: patch.size.x, height: patch.size.y, data: data.to_vec() };
    let mut target = image(&patch.cut(&target.data));
    if adjusts {
        // Floaters are errors of the render, which do not change the expected gain.
        let affine = Affine::least_squares(&target, &image(colors)).unwrap_or(Affine::IDENTITY);
        target = affine.applied(&target);
    }
    let residual = colors.iter().zip(&target.data).enumerate();
    let residual =
        residual.map(|(at, (value, target))| 2.0 * (value - target) * counts(at)).collect();
    let probe = |probe: usize| {
        let sign = |at: usize| {
            let draw = (probe * colors.len() + at) as u64;
            if signs.uniform(draw) < 0.5 { -counts(at) } else { counts(at) }
        };
        (0..colors.len()).map(sign).collect()
    };
    std::iter::once(residual).chain((0..PROBES).map(probe)).collect()
}
