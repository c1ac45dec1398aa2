//! Patches: photographs too large for the device train in parts.
//!
//! A step trains on one patch as if it were a view. Measurements, target and exposure are those of the whole
//! photograph.

use std::ops::RangeInclusive;

use glam::UVec2;
use nightsplat_core::camera::{Camera, Patch};
use nightsplat_photographs::image::Image;

use super::config::{MIN_PATCH, TrainConfig};
use super::model::{MARGIN, TrainedModel};
use super::views::{ImageKind, TrainView, TrainingPhotograph, Views};
use crate::gpu::Gpu;
use crate::networks::{Denoiser, Tonemapper};
use crate::targets::pseudo_gt::PseudoGt;
use crate::{Error, Result};

impl TrainConfig {
    /// The patches of a view: a single one if the device and [`TrainConfig::patch_pixels`] allow it.
    pub(crate) fn patches(&self, gpu: &Gpu, camera: &Camera) -> Vec<Patch> {
        let (settings, model) = (self.render_settings(), &self.model);
        // Networks on crops only bind the crops.
        let sees_all = model.denoiser_crop == 0;
        let denoiser = (sees_all && model.denoiser).then_some(model.network);
        let tonemapper = sees_all && model.tonemapper;
        camera.patches(|size| {
            settings.takes_at_once(gpu, size)
                && denoiser.is_none_or(|denoiser| Denoiser::fits_on(gpu, denoiser, size))
                && (!tonemapper || Tonemapper::fits_on(gpu, size))
        })
    }
}

impl Views {
    /// A smaller patch size if the first Gaussians of the model have too many intersections with the present one;
    /// `None` otherwise, or if smaller patches do not help.
    pub(super) fn fewer_patch_pixels(&self, model: &mut TrainedModel) -> Result<Option<u64>> {
        let of_photograph = |patch: &Patch| Patch::from(&patch.camera).pixel_count();
        let patches = || self.whole().iter().map(|view| (view.photograph, view.patch));
        let largest = patches().max_by_key(|(_, patch)| of_photograph(patch));
        let Some((largest, _)) = largest else { return Ok(None) };
        let patches: Vec<Patch> = patches()
            .filter(|&(photograph, _)| photograph == largest)
            .map(|(_, patch)| patch)
            .collect();
        let TrainedModel { gaussians, renderer, .. } = model;
        let mut met = 0;
        for patch in &patches {
            met = met.max(renderer.count_intersections(gaussians.values.slice(), patch)?);
        }
        let share = f64::from(renderer.max_intersections()) / (MARGIN * f64::from(met));
        let pixels = patches.iter().map(Patch::pixel_count).max().unwrap_or_default();
        let fewer = (share.min(1.0) * pixels as f64) as u64;
        Ok((share < 1.0 && fewer >= MIN_PATCH).then_some(fewer))
    }

    /// Logs the photographs that are trained in patches.
    pub(super) fn log_patches(&self, gpu: &Gpu) {
        let mut cut = self.photographs().filter(|view| !view.patch.is_whole());
        let Some(TrainView { name, photograph, patch, .. }) = cut.next() else { return };
        let patch_count = self.whole().iter().filter(|view| view.photograph == *photograph).count();
        let (Camera { width, height, .. }, UVec2 { x, y }) = (patch.camera, patch.size);
        tracing::warn!(
            "{} of {} photographs are trained in patches, due to {} or patch_pixels: {name}, \
             {width}x{height}, in {patch_count} of about {x}x{y}",
            1 + cut.count(),
            self.photographs().count(),
            gpu.properties().name
        );
    }

    /// The target of a photograph, at its full size.
    pub(super) fn picture(
        &self,
        pseudo_gt: &PseudoGt,
        photograph: TrainingPhotograph,
    ) -> Result<Image> {
        let pictures = self.pictures(pseudo_gt, photograph..=photograph, ImageKind::Targets)?;
        let gone = || Error::Usage(format!("there is no training photograph {}", photograph.0));
        pictures.into_iter().next().ok_or_else(gone)
    }

    /// Images of photographs at full size, assembled from their patches.
    pub(super) fn pictures(
        &self,
        pseudo_gt: &PseudoGt,
        photographs: RangeInclusive<TrainingPhotograph>,
        shown: ImageKind,
    ) -> Result<Vec<Image>> {
        let views = self.of_photographs(photographs);
        Ok(put_together(views, self.read(pseudo_gt, views, shown)?))
    }

    /// The full-size patches of some photographs.
    pub(super) fn of_photographs(
        &self,
        photographs: RangeInclusive<TrainingPhotograph>,
    ) -> &[TrainView] {
        let views = self.whole();
        let begin = views.partition_point(|view| view.photograph < *photographs.start());
        let end = views.partition_point(|view| view.photograph <= *photographs.end());
        &views[begin..end]
    }
}

/// Images of photographs from their patches, (3, h, w) each.
pub(super) fn put_together(views: &[TrainView], parts: Vec<Vec<f32>>) -> Vec<Image> {
    let mut images: Vec<Image> = vec![];
    for (TrainView { patch, .. }, data) in views.iter().zip(parts) {
        let Camera { width, height, .. } = patch.camera;
        if patch.is_whole() {
            images.push(Image { width, height, data });
            continue;
        }
        if patch.is_first() {
            images.push(Image::filled(width, height, [0.0; 3]));
        }
        if let Some(image) = images.last_mut() {
            patch.paste(patch, &data, &Patch::from(&patch.camera), &mut image.data);
        }
    }
    images
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DVec2};

    use super::*;
    use crate::gpu::testing::{gpu, not_run};
    use crate::train::Part;
    use nightsplat_core::camera::CameraModel;

    fn camera(width: u32, height: u32) -> Camera {
        let size = DVec2::new(width.into(), height.into());
        Camera {
            width,
            height,
            focal: size,
            principal_point: 0.5 * size,
            model: CameraModel::Pinhole,
            view_from_world: DAffine3::IDENTITY,
        }
    }

    #[test]
    fn the_device_limits_determine_the_number_of_patches() {
        let gpu = gpu();
        if gpu.properties().max_storage_buffer_range != 1 << 27 {
            let binds = gpu.properties().max_storage_buffer_range;
            return not_run("lavapipe", format_args!("this device binds {binds} bytes"));
        }
        let mut config = TrainConfig::bare();
        let count = |config: &TrainConfig, width, height| {
            let patches = config.patches(&gpu, &camera(width, height));
            patches.iter().for_each(|patch| assert!(patch.pixel_count() <= 1 << 24));
            patches.len()
        };
        // Colour alone: 12 bytes a pixel.
        assert_eq!(count(&config, 4000, 2655), 1);
        assert_eq!(count(&config, 8000, 5310), 4);
        assert_eq!(count(&config, 65_535, 65_535), 400);
        // With features: 44 bytes; then networks with maps of the whole view.
        config.model.set_parts(&Part::ALL);
        config.model.denoiser_crop = 256;
        assert_eq!(count(&config, 4000, 2655), 4);
        config.model.denoiser_crop = 0;
        assert_eq!(count(&config, 4000, 2655), 6);
        // A view that fits in no patch stays whole and is refused later.
        config.patch_pixels = Some(100);
        assert_eq!(count(&config, 400, 300), 1);
    }
}
