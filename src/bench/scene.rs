//! The scene of the bench: a synthetic one with the statistics of a trained one, or a trained model.

use std::path::{Path, PathBuf};

use glam::{DAffine3, DVec2, DVec3, Vec3};
use nightsplat_core::camera::{Camera, CameraModel};
use nightsplat_core::random::Stream;
use nightsplat_models::gaussians::{Features, Gaussians, MAX_SH_DEGREE, SH_C0, Shape};
use nightsplat_photographs::dataset::{Dataset, Point, Split, View};
use nightsplat_photographs::image::Image;
use nightsplat_photographs::tone::{ToneCurve, ToneSettings};

use crate::Result;
use crate::gpu::{CheckReport, Gpu};
use crate::results::{models, run};
use crate::splats::batches::GradientKind;
use crate::splats::device::Upload;
use crate::splats::model::Model;
use crate::splats::render::{RenderOptions, RenderSettings, Renderer, Status};
use crate::train::{Part, PrecisionConfig, TrainConfig, Trainer};

/// Where the Gaussians come from.
#[derive(Debug)]
pub(crate) enum Source {
    /// This number is made.
    Synthetic(usize),
    /// A trained model, seen by a camera.
    Model { path: PathBuf, model: Box<Model>, camera: Camera },
}

impl Source {
    /// Reads a model. A run is seen by its first training camera; a file has no cameras, and is seen along z from where
    /// most of it is in view.
    pub(crate) fn open(path: &Path, size: [u32; 2]) -> Result<Self> {
        let (gaussians, facts) = models::read(path)?;
        let mut model = Model::of_shown(gaussians, &facts);
        let camera_of_run = match path.is_dir() {
            true => {
                let config = run::load_config(path)?;
                let dataset = Dataset::load(&config.dataset, &config.load_options())?;
                dataset.train_views().next().map(|view| view.camera)
            }
            false => None,
        };
        let camera = camera_of_run.unwrap_or_else(|| facing(&model.gaussians, size));
        let origin = std::mem::take(&mut model.gaussians.origin);
        let view_from_world = camera.view_from_world * DAffine3::from_translation(origin);
        let camera = Camera { view_from_world, ..camera };
        Ok(Self::Model { path: path.to_owned(), model: Box::new(model), camera })
    }

    /// The width and height of the camera; the synthetic scene fits any.
    pub(crate) fn size(&self) -> Option<[u32; 2]> {
        match self {
            Self::Synthetic(_) => None,
            Self::Model { camera, .. } => Some([camera.width, camera.height]),
        }
    }

    /// The scene in a view of this size.
    pub(crate) fn scene(&self, [width, height]: [u32; 2], features: Features) -> BenchScene {
        match self {
            Self::Synthetic(count) => {
                let camera = camera(width, height);
                let shape = Shape { sh_degree: MAX_SH_DEGREE, features };
                BenchScene { gaussians: gaussians(&camera, *count, shape), camera, near: None }
            }
            Self::Model { model, camera, .. } => BenchScene {
                camera: camera.framed([width, height]),
                gaussians: model.gaussians.with_sh_degree(MAX_SH_DEGREE).with_features(features),
                near: Some(model.near),
            },
        }
    }

    pub(crate) fn name(&self) -> String {
        match self {
            Self::Synthetic(_) => "synthetic".to_owned(),
            Self::Model { path, .. } => path.display().to_string(),
        }
    }
}

/// Gaussians before a camera.
#[derive(Clone, Debug)]
pub struct BenchScene {
    /// That of the synthetic scene is at the origin and looks along z.
    pub camera: Camera,
    /// Of the highest SH degree.
    pub gaussians: Gaussians,
    /// The near plane of a trained model, in its units.
    pub near: Option<f32>,
}

/// Mean and deviation of the natural logarithm of a Gaussian's standard deviation in pixels. 20 000 Gaussians then have
/// about 65 000 intersections at 512x384.
const LOG_PIXELS: [f64; 2] = [0.545, 0.8];

/// Random draws per Gaussian; each normal one takes two counters.
const DRAWS: u64 = 32;

impl BenchScene {
    /// `count` Gaussians in a view of `width` x `height` pixels.
    pub fn new(width: u32, height: u32, count: usize) -> Self {
        Source::Synthetic(count).scene([width, height], Features::NONE)
    }

    /// The settings of a renderer of the scene.
    pub(crate) fn render_settings(&self) -> RenderSettings {
        let defaults = RenderSettings { shape: self.gaussians.shape, ..RenderSettings::default() };
        RenderSettings { near: self.near.unwrap_or(defaults.near), ..defaults }
    }

    /// One view with a depth map; the points are the means of the Gaussians.
    fn dataset(&self) -> Dataset {
        let Camera { width, height, .. } = self.camera;
        let depth = (0..width * height).map(|i| (i / width) as f32 / height as f32);
        let view = View::new("view", Split::Train, self.camera, Some(dark(width, height)));
        let view = View { depth: Some(depth.collect()), ..view };
        let point = |mean: &Vec3| Point { position: mean.as_dvec3(), views: vec![0] };
        let points = self.gaussians.means().iter().map(point).collect();
        Dataset { root: PathBuf::new(), views: vec![view], points, skipped: vec![] }
    }
}

/// Trainers of the scene.
pub(crate) struct Trainers {
    /// Colour only, with SH of degree 3.
    pub(crate) plain: Trainer,
    /// Every part, small enough for the references.
    pub(crate) lita: Trainer,
    /// The checked passes of its initialisation and targets.
    pub(crate) lita_begins: CheckReport,
    /// Number of splat-tile intersections of the plain scene.
    pub(crate) intersections: u32,
}

pub(crate) fn trainers(
    gpu: &Gpu,
    scene: &BenchScene,
    precision: &PrecisionConfig,
) -> Result<Trainers> {
    let plain = plain(gpu, scene, precision)?;
    let (lita, lita_begins) = gpu.checked(|| lita(gpu, precision));
    Ok(Trainers { plain, lita: lita?, lita_begins, intersections: intersections(gpu, scene)? })
}

/// A configuration whose steps all do the same work once all SH degrees are in use.
fn config(precision: &PrecisionConfig) -> TrainConfig {
    let tone = ToneSettings::new(ToneCurve::Ap3);
    let mut config = TrainConfig { tone, precision: precision.clone(), ..TrainConfig::bare() };
    config.schedule.sh_degree_interval = 1;
    config.schedule.initial_rate_factor = 1.0;
    config.schedule.densify_after = i64::MAX as u64;
    config.schedule.resolution_steps = Some([0, 0]);
    config
}

/// The plain model after the steps that enable all SH degrees.
pub fn plain(gpu: &Gpu, scene: &BenchScene, precision: &PrecisionConfig) -> Result<Trainer> {
    let dataset = scene.dataset();
    let mut config = config(precision);
    if let Some(near) = scene.near {
        config.near = (f64::from(near) / dataset.extent()).clamp(1e-6, 1.0);
        // A model stays what it is.
        config.schedule.initial_rates = config.schedule.initial_rates.scaled(1e-6);
    }
    let Camera { width, height, .. } = scene.camera;
    config.tile = Some(config.render_settings().tile_for(gpu, std::iter::once([width, height]))?);
    let mut trainer = Trainer::from_gaussians(gpu, config, &dataset, &scene.gaussians)?;
    while trainer.steps_done() < 3 {
        trainer.advance(3)?;
    }
    Ok(trainer)
}

/// All parts on a small scene, with densification in every step.
fn lita(gpu: &Gpu, precision: &PrecisionConfig) -> Result<Trainer> {
    let mut config = config(precision);
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

/// The number of splat-tile intersections. The renderer has the backward kernels of edits, so that compilers of GPUs
/// are tried on them.
fn intersections(gpu: &Gpu, scene: &BenchScene) -> Result<u32> {
    let BenchScene { camera, gaussians, .. } = scene;
    let settings = scene.render_settings();
    let mut renderer = Renderer::with_gradients(gpu, settings, GradientKind::All, 0)?;
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

/// Looking along z at the middle of the Gaussians, from where nine tenths of them are in view.
fn facing(gaussians: &Gaussians, [width, height]: [u32; 2]) -> Camera {
    let share = |mut values: Vec<f64>, share: f64| {
        let nth = (share * values.len() as f64) as usize;
        values.sort_by(f64::total_cmp);
        values.get(nth).copied().unwrap_or_default()
    };
    let means: Vec<DVec3> = gaussians.means().iter().map(Vec3::as_dvec3).collect();
    let middle = |axis: usize| share(means.iter().map(|mean| mean[axis]).collect(), 0.5);
    let middle = DVec3::from_array([0, 1, 2].map(middle));
    let radius = share(means.iter().map(|mean| mean.distance(middle)).collect(), 0.9);
    let camera = camera(width, height);
    let distance = radius * camera.focal.x / (0.5 * f64::from(width.min(height)));
    let to_view = DVec3::Z * distance - middle;
    Camera { view_from_world: DAffine3::from_translation(to_view), ..camera }
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
