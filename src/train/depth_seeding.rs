//! Depth seeding: more Gaussians at rendered depths, for datasets with few points.
//!
//! A few Gaussians learn the depth of the scene within a hundred steps, but a round of density control at most doubles
//! them. Instead, the first round turns pixels of some training views into Gaussians: of the pixel's colour, at the
//! expected depth rendered there. The moments of all Gaussians are reset.

use glam::{DVec2, DVec3, Vec3};
use nightsplat_core::camera::{Camera, Patch};
use nightsplat_core::random::Stream;
use nightsplat_models::attributes::{AttributePlane, planes};
use nightsplat_models::gaussians::init::Initialization;
use nightsplat_models::gaussians::{Gaussians, SH_C0, width};
use nightsplat_photographs::image::Image;

use super::clock::RunClock;
use super::config::TrainConfig;
use super::gaussians::TrainedGaussians;
use super::model::TrainedModel;
use super::patches::put_together;
use super::streams;
use super::supervision::Supervision;
use super::views::{TrainView, Views};
use crate::Result;
use crate::gpu::Gpu;
use crate::splats::device::Upload;
use crate::splats::lamp::Lamp;
use crate::splats::packed_sh::StorageFormat;
use crate::splats::render::{RenderOptions, RenderSettings, Renderer};
use nightsplat_photographs::exposures::Affine;

/// The most views that are sampled.
const VIEWS: usize = 16;
/// Sampled pixels for each Gaussian.
const PIXELS_EACH: usize = 4;
/// The fewest pixels of a view for each Gaussian: with more Gaussians, the scores of small views may be lower after
/// thousands of steps.
const MIN_PIXELS_EACH: usize = 8;
/// The least alpha at which a pixel has a depth.
const MIN_COVER: f32 = 0.5;

/// A pixel's point and colour, in the frame.
#[derive(Clone, Copy, Debug, PartialEq)]
struct DepthSample {
    position: DVec3,
    color: Vec3,
}

/// Whether the round after this step seeds: it is the first, and there are few Gaussians.
pub(super) fn seeds_at(config: &TrainConfig, views: &Views, step: u64, count: usize) -> bool {
    let is_due = step == config.schedule.first_round();
    is_due && count <= config.density.sparse_threshold() && count < seeded_count(config, views)
}

/// The number of Gaussians after that round.
pub(super) fn seeded_count(config: &TrainConfig, views: &Views) -> usize {
    let pixels = |view: &TrainView| Patch::from(&view.patch.camera).pixel_count();
    let most = views.photographs().map(pixels).max().unwrap_or_default();
    config.density.depth_seeding.min(most / MIN_PIXELS_EACH)
}

/// The number of Gaussians, of which there are `count`, after a seeding that is still to come.
pub(super) fn count_once_seeded(
    config: &TrainConfig,
    clock: &RunClock,
    views: &Views,
    count: usize,
) -> usize {
    let first = config.schedule.first_round();
    let is_to_come = clock.step < first && clock.densifies_at(first);
    let seeds = is_to_come && seeds_at(config, views, first, count);
    if seeds { seeded_count(config, views).max(count) } else { count }
}

/// Adds Gaussians to the model until there are `wanted`.
pub(super) fn seed_depths(
    gpu: &Gpu,
    config: &TrainConfig,
    supervision: &Supervision,
    model: &mut TrainedModel,
    step: u64,
    wanted: usize,
) -> Result<()> {
    let more = wanted.saturating_sub(model.count());
    if more == 0 {
        return Ok(());
    }
    let old = model.gaussians.download(gpu)?;
    // Non-finite parameters are reported by the next check.
    if !old.means().iter().all(|mean| mean.is_finite()) {
        return Ok(());
    }
    let sampler = Sampler { gpu, supervision, lamp: model.renderer.lamp()? };
    let depth_samples = sampler.samples(config, &old, more)?;
    let draws = Stream::new(config.seed, streams::FILL);
    let mut order: Vec<usize> = (0..depth_samples.len()).collect();
    order.sort_by_key(|&i| draws.bits(i as u64));
    let picked: Vec<DepthSample> = order.into_iter().take(more).map(|i| depth_samples[i]).collect();
    tracing::info!(
        "step {step}: {} Gaussians seeded at rendered depths, in addition to {}",
        picked.len(),
        old.count
    );
    let filled = joined(&old, &picked, &config.start)?;
    let (in_use, frozen_columns) = (model.gaussians.shape().sh_degree, config.frozen_columns());
    model.gaussians =
        TrainedGaussians::upload(gpu, &filled, in_use, &config.precision, frozen_columns)?;
    Ok(())
}

/// Samples training views at the depths of Gaussians.
struct Sampler<'a> {
    gpu: &'a Gpu,
    supervision: &'a Supervision,
    /// Whose light is not in the colours of samples.
    lamp: Option<Lamp>,
}

impl Sampler<'_> {
    /// Samples of some views, about [`PIXELS_EACH`] times `more`.
    fn samples(
        &self,
        config: &TrainConfig,
        gaussians: &Gaussians,
        more: usize,
    ) -> Result<Vec<DepthSample>> {
        let settings = RenderSettings {
            shape: 0.into(),
            raw_colors: true,
            rest: StorageFormat::Single,
            lamp: None,
            ..config.render_settings()
        };
        let mut renderer = Renderer::new(self.gpu, settings)?;
        let Supervision { views, targets, .. } = self.supervision;
        let exposures = self.supervision.affines()?;
        let count = views.photographs().count();
        let sampled = views.photographs().step_by(count.div_ceil(VIEWS).max(1));
        let pixels = PIXELS_EACH * more / count.clamp(1, VIEWS);
        let mut depth_samples = vec![];
        for view in sampled {
            let camera = coarse(&view.patch.camera, pixels);
            let depths = self.depths(&mut renderer, gaussians, &camera)?;
            let target = views.picture(&targets.pseudo_gt, view.photograph)?;
            let exposure = exposures.get(view.photograph.0);
            let neutral = exposure.map(Affine::inverse).map(|inverse| inverse.applied(&target));
            let target = neutral.unwrap_or(target).resized(camera.width, camera.height);
            let mask = self.mask_of(view)?.map(|mask| mask.resized(camera.width, camera.height));
            let mut samples = seen(&camera, &depths, &target, mask.as_ref());
            if let Some(lamp) = &self.lamp {
                for sample in &mut samples {
                    let in_view = camera.view_from_world.transform_point3(sample.position);
                    sample.color = lamp.unlit(sample.color, in_view);
                }
            }
            depth_samples.extend(samples);
        }
        Ok(depth_samples)
    }

    /// Renders the alpha-weighted depth and the accumulated alpha instead of colours.
    fn depths(
        &self,
        renderer: &mut Renderer,
        gaussians: &Gaussians,
        camera: &Camera,
    ) -> Result<Image> {
        let mut bare = Gaussians::zeros(gaussians.count, 0);
        bare.means_mut().copy_from_slice(gaussians.means());
        bare.quats_mut().copy_from_slice(gaussians.quats());
        bare.log_scales_mut().copy_from_slice(gaussians.log_scales());
        bare.raw_opacities_mut().copy_from_slice(gaussians.raw_opacities());
        for (dc, mean) in bare.dc_mut().iter_mut().zip(gaussians.means()) {
            let depth = camera.depth(mean.as_dvec3()).unwrap_or_default();
            *dc = Vec3::new(depth as f32, 1.0, 0.0) / SH_C0;
        }
        renderer.reserve(bare.count, [camera])?;
        let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
        renderer.render_image(&bare.upload(self.gpu)?, camera, &options)
    }

    /// The mask of a view, as an image of three equal channels.
    fn mask_of(&self, view: &TrainView) -> Result<Option<Image>> {
        let Supervision { views, masks, .. } = self.supervision;
        if masks.of_view(view.id).is_none() {
            return Ok(None);
        }
        let views = views.of_photographs(view.photograph..=view.photograph);
        let weights = |view: &TrainView| {
            let weights = masks.of_view(view.id).map(|weights| self.gpu.read(weights));
            Ok(weights.transpose()?.unwrap_or_default().repeat(3))
        };
        let parts = views.iter().map(weights).collect::<Result<_>>()?;
        Ok(put_together(views, parts).pop())
    }
}

/// The camera with about `pixels` pixels, if it has more.
fn coarse(camera: &Camera, pixels: usize) -> Camera {
    let camera_pixels = f64::from(camera.width) * f64::from(camera.height);
    let scale = (pixels as f64 / camera_pixels).sqrt().min(1.0);
    let side = |side: u32| ((f64::from(side) * scale).round() as u32).max(1);
    camera.resized(side(camera.width), side(camera.height))
}

/// The samples of pixels that are covered and not masked.
fn seen(camera: &Camera, depths: &Image, target: &Image, mask: Option<&Image>) -> Vec<DepthSample> {
    let (pixels, world_from_view) = (depths.pixel_count(), camera.view_from_world.inverse());
    let depth_sample = |at: usize| {
        let cover = depths.data[pixels + at];
        let depth = f64::from(depths.data[at] / cover);
        let (column, row) = (at % camera.width as usize, at / camera.width as usize);
        let pixel = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
        let position = world_from_view.transform_point3(camera.in_view(pixel, depth)?);
        let color = Vec3::from_array([0, 1, 2].map(|c| target.data[c * pixels + at]));
        let counts = mask.is_none_or(|mask| mask.data[at] >= 1.0);
        let is_sound = cover >= MIN_COVER && position.is_finite() && color.is_finite();
        (counts && is_sound).then_some(DepthSample { position, color })
    };
    (0..pixels).filter_map(depth_sample).collect()
}

/// The old Gaussians, then those of the samples, with the features of their nearest old Gaussian.
fn joined(old: &Gaussians, new: &[DepthSample], start: &Initialization) -> Result<Gaussians> {
    let means = old.means().iter().map(|mean| mean.as_dvec3());
    let positions: Vec<DVec3> =
        means.chain(new.iter().map(|depth_sample| depth_sample.position)).collect();
    let colors = std::iter::repeat_n(Vec3::ZERO, old.count);
    let colors: Vec<Vec3> =
        colors.chain(new.iter().map(|depth_sample| depth_sample.color)).collect();
    let mut all = Gaussians::from_points(&positions, &colors, old.shape, start, 0)?;
    let features = old.shape.features.width();
    for AttributePlane { column, width, .. } in planes(features, width(old.shape)) {
        let (from, to) = (column * old.count, column * all.count);
        let old_values = &old.parameters[from..from + width * old.count];
        all.parameters[to..to + old_values.len()].copy_from_slice(old_values);
    }
    if features > 0 {
        let nearest = |depth_sample: &DepthSample| {
            let distance = |i: &usize| positions[*i].distance_squared(depth_sample.position);
            (0..old.count).min_by(|a, b| distance(a).total_cmp(&distance(b)))
        };
        let all_features = all.features_mut();
        for (i, nearest) in new.iter().map(nearest).enumerate() {
            let Some(nearest) = nearest else { continue };
            let from = features * nearest;
            all_features.copy_within(from..from + features, features * (old.count + i));
        }
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use glam::DAffine3;

    use super::*;
    use nightsplat_core::camera::CameraModel;
    use nightsplat_models::gaussians::{Features, Shape};

    fn camera(width: u32, height: u32) -> Camera {
        let (focal, principal_point) = (DVec2::splat(2.0), DVec2::new(1.0, 0.5));
        let view_from_world = DAffine3::from_translation(DVec3::new(0.0, 0.0, 1.0));
        Camera {
            width,
            height,
            focal,
            principal_point,
            model: CameraModel::Pinhole,
            view_from_world,
        }
    }

    #[test]
    fn a_pixel_is_placed_at_its_expected_depth_unless_it_is_thinly_covered_or_masked() {
        // Weighted depth 2 and alpha 1/2 give depth 4.
        let image = |data: &[f32]| Image { width: 2, height: 1, data: data.to_vec() };
        let target = image(&[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]);
        let shown =
            |data: &[f32], mask: Option<&Image>| seen(&camera(2, 1), &image(data), &target, mask);
        let left =
            DepthSample { position: DVec3::new(-1.0, 0.0, 3.0), color: Vec3::new(0.1, 0.3, 0.5) };
        assert_eq!(shown(&[2.0, 0.4, 0.5, 0.4, 0.0, 0.0], None), [left]);
        let nothing: [DepthSample; 0] = [];
        for depth in [f32::NAN, f32::INFINITY] {
            assert_eq!(shown(&[depth, 0.0, 1.0, 0.0, 0.0, 0.0], None), nothing);
        }
        assert_eq!(shown(&[4.0, 4.0, f32::NAN, 0.0, 0.0, 0.0], None), nothing);
        let mask = image(&[1.0, 0.9, 1.0, 0.9, 1.0, 0.9]);
        assert_eq!(shown(&[4.0, 4.0, 1.0, 1.0, 0.0, 0.0], Some(&mask)), [left]);
    }

    #[test]
    fn a_coarse_camera_has_about_as_many_pixels_as_requested_and_at_least_one() {
        for (pixels, size) in [(0, (1, 1)), (50, (10, 5)), (200, (20, 10)), (9999, (20, 10))] {
            let coarse = coarse(&camera(20, 10), pixels);
            assert_eq!((coarse.width, coarse.height), size, "{pixels}");
        }
    }

    #[test]
    fn new_gaussians_take_the_features_of_the_nearest_and_leave_the_others_unchanged() {
        let features = Features { structure: true, ..Features::NONE };
        let shape = Shape { sh_degree: 1, features };
        let mut old = Gaussians::zeros(2, shape);
        let numbers = old.parameters.len();
        old.parameters = (0..numbers).map(|i| i as f32).collect();
        let near = DVec3::new(3.0, 4.0, 5.5);
        let new = [DepthSample { position: near, color: Vec3::ONE }];
        let all = joined(&old, &new, &Initialization::default()).unwrap();
        assert_eq!((all.count, all.means()[2]), (3, near.as_vec3()));
        assert_eq!((&all.means()[..2], &all.rest()[..6]), (old.means(), old.rest()));
        assert_eq!(all.features()[..2], *old.features());
        assert_eq!(all.features()[2], old.features()[1]);
        assert!(all.raw_opacities()[2] < 0.0 && all.rest()[6..].iter().all(|c| *c == Vec3::ZERO));
        assert_eq!(joined(&old, &[], &Initialization::default()).unwrap(), old);
        let none = Gaussians::zeros(0, shape);
        assert_eq!(joined(&none, &new, &Initialization::default()).unwrap().count, 1);
    }
}
