//! The synthetic scene of the bench, with the statistics of a trained one.

use std::path::PathBuf;

use glam::{DAffine3, DVec2, Vec3};

use crate::Result;
use crate::base::random::Stream;
use crate::camera::{Camera, CameraModel};
use crate::gpu::{CheckReport, Gpu};
use crate::photographs::dataset::{Dataset, Point, Split, View};
use crate::photographs::image::Image;
use crate::photographs::tone::{ToneCurve, ToneSettings};
use crate::splats::render::{RenderOptions, RenderSettings, Renderer, Status};
use crate::splats::scene::{Gaussians, SH_C0, Shape};
use crate::train::{Part, TrainConfig, Trainer};

/// Gaussians before a camera that looks along z from the origin.
#[derive(Clone, Debug)]
pub struct BenchScene {
    /// At the origin.
    pub camera: Camera,
    /// In the camera's view.
    pub gaussians: Gaussians,
    /// A dark photograph of the camera's size.
    pub low: Image,
}

/// Mean and deviation of the natural logarithm of a Gaussian's standard deviation in pixels. 20 000 Gaussians then have
/// about 65 000 intersections at 512x384.
const LOG_PIXELS: [f64; 2] = [0.545, 0.8];

/// Random draws per Gaussian; each normal one takes two counters.
const DRAWS: u64 = 32;

impl BenchScene {
    /// `count` Gaussians in a view of `width` x `height` pixels.
    pub fn new(width: u32, height: u32, count: usize) -> Self {
        let camera = camera(width, height);
        Self { low: dark(width, height), gaussians: gaussians(&camera, count, 3), camera }
    }

    /// One view with a depth map; the points are the means of the Gaussians.
    fn dataset(&self) -> Dataset {
        let Camera { width, height, .. } = self.camera;
        let depth = (0..width * height).map(|i| (i / width) as f32 / height as f32);
        let view = View::new("view", Split::Train, self.camera, Some(self.low.clone()));
        let view = View { depth: Some(depth.collect()), ..view };
        let point = |mean: &Vec3| Point { position: mean.as_dvec3(), views: vec![0] };
        let points = self.gaussians.means().iter().map(point).collect();
        Dataset { root: PathBuf::new(), views: vec![view], points, skipped: vec![] }
    }
}

/// Trainers of the scene.
pub(super) struct Trainers {
    /// Colour only, with SH of degree 3.
    pub(super) plain: Trainer,
    /// Every part, small enough for the references.
    pub(super) lita: Trainer,
    /// The checked passes of its initialisation and targets.
    pub(super) lita_begins: CheckReport,
    /// Number of splat-tile intersections of the plain scene.
    pub(super) intersections: u32,
}

pub(super) fn trainers(gpu: &Gpu, scene: &BenchScene) -> Result<Trainers> {
    let plain = plain(gpu, scene)?;
    let (lita, lita_begins) = gpu.checked(|| lita(gpu));
    Ok(Trainers { plain, lita: lita?, lita_begins, intersections: intersections(gpu, scene)? })
}

/// A configuration whose steps all do the same work once all SH degrees are in use.
fn config() -> TrainConfig {
    let mut config = TrainConfig { tone: ToneSettings::new(ToneCurve::Ap3), ..TrainConfig::bare() };
    config.schedule.sh_degree_interval = 1;
    config.schedule.initial_rate_factor = 1.0;
    config.schedule.densify_after = i64::MAX as u64;
    config.schedule.resolution_steps = [0, 0];
    config
}

/// The plain model after the steps that enable all SH degrees.
pub fn plain(gpu: &Gpu, scene: &BenchScene) -> Result<Trainer> {
    let dataset = scene.dataset();
    let mut config = config();
    let Camera { width, height, .. } = scene.camera;
    config.tile = Some(config.render_settings().tile_for(gpu, std::iter::once([width, height]))?);
    let mut trainer = Trainer::from_gaussians(gpu, config, &dataset, &scene.gaussians)?;
    while trainer.steps_done() < 3 {
        trainer.advance(3)?;
    }
    Ok(trainer)
}

/// All parts on a small scene, with densification in every step.
fn lita(gpu: &Gpu) -> Result<Trainer> {
    let mut config = config();
    config.model.follow_paper();
    config.model.set_parts(&Part::LITA);
    config.ssim_weight = 0.0;
    config.model.denoiser_crop = 24;
    config.model.network.channels = 8;
    config.model.network.stages = 2;
    config.model.network.repeats = 2;
    (config.schedule.densify_after, config.schedule.densify_interval) = (0, 1);
    Trainer::new(gpu, config, &BenchScene::new(96, 72, 500).dataset())
}

/// The number of splat-tile intersections.
fn intersections(gpu: &Gpu, BenchScene { camera, gaussians, .. }: &BenchScene) -> Result<u32> {
    let mut renderer = Renderer::new(gpu, RenderSettings::default())?;
    renderer.reserve(gaussians.count, [camera])?;
    let parameters = gaussians.upload(gpu)?;
    let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
    gpu.run("render", |pass| renderer.forward(pass, &parameters, camera, &options))?;
    Ok(Status::from_words(&gpu.read(renderer.status())?).intersections)
}

/// At the origin, looking along z.
pub fn camera(width: u32, height: u32) -> Camera {
    Camera {
        width,
        height,
        focal: DVec2::splat(0.9 * f64::from(width)),
        principal_point: DVec2::new(0.51 * f64::from(width), 0.49 * f64::from(height)),
        model: CameraModel::Pinhole,
        view_from_world: DAffine3::IDENTITY,
    }
}

/// Gaussians spread over the camera's view, with sizes in pixels that do not depend on the resolution.
pub fn gaussians(camera: &Camera, count: usize, shape: impl Into<Shape>) -> Gaussians {
    let stream = Stream::new(65, 0);
    let uniform = |gaussian: usize, draw: u64| stream.uniform(gaussian as u64 * DRAWS + draw);
    let normal =
        |gaussian: usize, draw: u64| stream.normal(gaussian as u64 * DRAWS / 2 + draw) as f32;
    let size = DVec2::new(camera.width.into(), camera.height.into());
    let mut gaussians = Gaussians::zeros(count, shape);
    for i in 0..count {
        let depth = 2.0 + 4.0 * uniform(i, 0);
        let pixel = size * DVec2::new(uniform(i, 1), uniform(i, 2));
        let in_view = camera.in_view(pixel, depth).unwrap_or_default();
        let axis = |draw: u64| {
            let log_pixels = LOG_PIXELS[0] + LOG_PIXELS[1] * f64::from(normal(i, draw));
            (log_pixels.exp().clamp(0.6, 20.0) * depth / camera.focal.x).ln() as f32
        };
        let opacity = 0.03 + 0.9 * uniform(i, 3).powi(2);
        gaussians.means_mut()[i] = in_view.as_vec3();
        gaussians.log_scales_mut()[i] = Vec3::new(axis(4), axis(5), axis(6));
        gaussians.quats_mut()[i] = [7, 8, 9, 10].map(|draw| normal(i, draw));
        gaussians.raw_opacities_mut()[i] = (opacity / (1.0 - opacity)).ln() as f32;
        gaussians.dc_mut()[i] =
            Vec3::from_array([11, 12, 13].map(|draw| normal(i, draw))) / SH_C0 / 6.0;
    }
    for (i, feature) in (0..).zip(gaussians.features_mut()) {
        *feature = Stream::new(65, 4).uniform(i) as f32;
    }
    // View dependence of a trained model is faint.
    for (i, coefficient) in (0..).zip(gaussians.rest_mut()) {
        let draw = |c: u64| 0.05 * Stream::new(65, 1).normal(3 * i + c) as f32;
        *coefficient = Vec3::from_array([0, 1, 2].map(draw));
    }
    gaussians
}

/// A smooth, dark image with noise.
pub fn dark(width: u32, height: u32) -> Image {
    let noise = Stream::new(65, 2);
    Image::from_fn(width, height, |x, y| {
        [0_u32, 1, 2].map(|channel| {
            let wave = (0.02 * f64::from(x + 31 * channel)).sin() * (0.03 * f64::from(y)).cos();
            let draw = u64::from(3 * (y * width + x) + channel);
            (0.06 + 0.04 * wave + 0.01 * noise.normal(draw)).max(0.0) as f32
        })
    })
}
