//! Gaussians and a view of them, rendered by the shipped renderer.

use glam::{DAffine3, DMat3, DVec2, DVec3, DVec4, UVec2, Vec2};
use nightsplat::gpu::testing::gpu;
use nightsplat::gpu::{Buffer, Tile};
use nightsplat::kernels::adam_step::BETA1;
use nightsplat::kernels::camera_pinhole::JACOBIAN_MARGIN;
use nightsplat::reference::camera::fisheye::Fisheye;
use nightsplat::reference::camera::pinhole::Pinhole;
use nightsplat::reference::camera::{ReferenceCamera, ReferenceLens};
use nightsplat::reference::gaussian::{Gaussian, Planes};
use nightsplat::reference::sh::sh_count;
use nightsplat::splats::batches::{Batches, GradientKind};
use nightsplat::splats::device::{DeviceGaussians, Upload};
use nightsplat::splats::lamp::Lamp;
use nightsplat::splats::optimizer::{
    Adam, AdamBuffers, AdamStep, GaussianStep, LearningRates, Moments,
};
use nightsplat::splats::render::{
    self, GradientNorm, RenderOptions, RenderSettings, Renderer, Status,
};
use nightsplat_core::camera::{self, CameraModel, KannalaBrandt, Patch};
use nightsplat_models::gaussians::{Features, Gaussians, Shape};
use nightsplat_photographs::tone::Profile;

use super::Random;

/// A camera profile that mixes channels, and bends each differently.
pub(crate) fn profile() -> Profile {
    let bent = |power: f64| (0..=16).map(|i| (f64::from(i) / 16.0).powf(power)).collect();
    Profile {
        reference: "a scene".to_owned(),
        pairs: 2,
        matrix: [[0.8, 0.25, -0.05], [-0.1, 1.2, -0.1], [0.0, 0.3, 0.7]],
        gain: [1.3, 0.9, 1.1],
        bias: [-0.1, 0.0, 0.05],
        segments: [0.6, 1.0, 1.7].map(bent),
    }
}

/// Gaussians, a view of them, and the specialization of the renderer.
#[derive(Clone)]
pub(crate) struct Setup {
    pub(crate) count: usize,
    pub(crate) parameters: Vec<f32>,
    pub(crate) camera: camera::Camera,
    pub(crate) settings: RenderSettings,
    pub(crate) options: RenderOptions,
    /// Whether gradients are those of a step of Adam, which completes those of the renderer.
    pub(crate) is_trained: bool,
}

impl Setup {
    /// `count` Gaussians within the view of a rotated pinhole camera with an off-centre principal point.
    pub(crate) fn new(count: usize, size: [u32; 2], shape: impl Into<Shape>, seed: u64) -> Self {
        Self::seen_by(CameraModel::Pinhole, count, size, shape, seed)
    }

    /// [`Setup::new`] for another camera model, with parameters that f32 represents.
    pub(crate) fn seen_by(
        model: CameraModel,
        count: usize,
        size: [u32; 2],
        shape: impl Into<Shape>,
        seed: u64,
    ) -> Self {
        let shape = shape.into();
        let (sin, cos) = 0.3f32.sin_cos();
        // All values are representable in f32, as for the kernels.
        let wide = |column: [f32; 3]| DVec3::from(column.map(f64::from));
        let [x, y, z] = [[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]].map(wide);
        let [width, height] = size;
        let camera = camera::Camera {
            width,
            height,
            focal: (Vec2::new(0.9, 0.8) * width as f32).as_dvec2(),
            principal_point: (Vec2::new(0.42, 0.57) * UVec2::from(size).as_vec2()).as_dvec2(),
            model,
            view_from_world: DAffine3 {
                matrix3: DMat3::from_cols(x, y, z),
                translation: wide([0.2, -0.1, 0.4]),
            },
        };
        let settings = RenderSettings { shape, ..RenderSettings::default() };
        let options = RenderOptions { sh_degree: shape.sh_degree, background: [0.0, 0.1, 0.2] };
        let mut setup =
            Self { count, parameters: vec![], camera, settings, options, is_trained: false };
        setup.parameters = vec![0.0; setup.planes().float_count()];
        let mut random = Random::new(seed);
        for i in 0..count {
            let gaussian = setup.random_gaussian(&mut random);
            setup.set(i, &gaussian);
        }
        setup
    }

    /// A Gaussian some pixels wide that projects into the image or next to it, also where slopes are clamped.
    fn random_gaussian(&self, random: &mut Random) -> Gaussian {
        let camera = self.camera();
        let depth = random.between(1.0, 5.0);
        let pixel = camera.size * DVec2::from_array([0; 2].map(|_| random.between(-0.25, 1.25)));
        let pixel_size = depth / camera.focal.x;
        Gaussian {
            mean: self.at_pixel(pixel, depth),
            quat: random.normals().into(),
            log_scale: [0; 3].map(|_| (pixel_size * random.between(0.3, 8.0)).ln()).into(),
            raw_opacity: random.between(-3.0, 6.0),
            features: (3..self.channels()).map(|_| random.between(-1.0, 2.0)).collect(),
            sh: (0..sh_count(self.settings.shape.sh_degree))
                .map(|k| (random.normals().map(|c: f64| c / (1.0 + k as f64))).into())
                .collect(),
        }
    }

    /// The world-space point at `pixel` and a depth; behind the camera if a fisheye does not see the pixel.
    pub(crate) fn at_pixel(&self, pixel: DVec2, depth: f64) -> DVec3 {
        let in_view = self.camera.in_view(pixel, depth).unwrap_or(DVec3::NEG_Z * depth);
        let camera = self.camera();
        camera.rotation.transpose() * (in_view - camera.translation)
    }

    pub(crate) fn planes(&self) -> Planes {
        let feature_count = self.channels() - 3;
        Planes {
            count: self.count,
            feature_count,
            sh_degree: self.settings.shape.sh_degree,
            rest_by_column: false,
        }
    }

    /// The camera as the references use it.
    pub(crate) fn camera(&self) -> ReferenceCamera {
        let camera::Camera { width, height, focal, principal_point, model, view_from_world } =
            self.camera;
        let size = UVec2::new(width, height).as_dvec2();
        let DAffine3 { matrix3: rotation, translation } = view_from_world;
        let margin = JACOBIAN_MARGIN * size;
        let model = match model {
            CameraModel::Pinhole => ReferenceLens::Pinhole(Pinhole {
                min_slope: -(principal_point + margin) / focal,
                max_slope: (size - principal_point + margin) / focal,
            }),
            CameraModel::Fisheye(lens) => ReferenceLens::Fisheye(Fisheye {
                distortion: lens.coefficients,
                largest_angle: lens.largest_angle(),
            }),
            CameraModel::Orthographic => ReferenceLens::Orthographic,
        };
        ReferenceCamera { rotation, translation, focal, principal_point, size, model }
    }

    pub(crate) fn get(&self, i: usize) -> Gaussian {
        self.planes().load(&self.parameters, i)
    }

    pub(crate) fn set(&mut self, i: usize, gaussian: &Gaussian) {
        let planes = self.planes();
        planes.store(gaussian, i, |at, value| self.parameters[at] = value as f32);
    }

    pub(crate) fn channels(&self) -> usize {
        self.settings.channels()
    }

    pub(crate) fn pixels(&self) -> usize {
        self.camera.width as usize * self.camera.height as usize
    }

    /// The background.
    pub(crate) fn background(&self) -> Vec<f32> {
        let mut background = self.options.background.to_vec();
        background.resize(self.channels(), 0.0);
        background
    }

    /// Uploads the Gaussians.
    pub(crate) fn upload(&self) -> DeviceGaussians {
        self.gaussians().upload(&gpu()).unwrap()
    }

    /// The Gaussians as a scene's.
    pub(crate) fn gaussians(&self) -> Gaussians {
        let mut gaussians = Gaussians::zeros(self.count, self.settings.shape);
        gaussians.parameters.copy_from_slice(&self.parameters);
        gaussians
    }

    /// 90 Gaussians over six tiles of 16x16 pixels: the uppermost rows are opaque after the first, the others continue.
    pub(crate) fn opaque_above(channels: usize) -> Self {
        let shape = Shape { sh_degree: 0, features: features(channels) };
        let mut setup = Self::new(90, [32, 35], shape, 52);
        for i in 0..12 {
            let mean = setup.at_pixel(DVec2::new(16.0, 2.0), 0.8 + 0.01 * i as f64);
            let log_scale = DVec3::new(0.5, 0.03, 0.03).map(f64::ln);
            let quat = DVec4::new(1.0, 0.0, 0.0, 0.0);
            setup.set(i, &Gaussian { mean, quat, log_scale, raw_opacity: 6.0, ..setup.get(i) });
        }
        setup
    }

    /// The render, with sufficient memory.
    pub(crate) fn render(&self) -> Rendered<'_> {
        let mut rendered = Rendered::new(self);
        let Rendered { renderer, gaussians, .. } = &mut rendered;
        renderer.render_channels(&*gaussians, &self.camera, &self.options).unwrap();
        if self.settings.trains_depth {
            rendered.forward();
        }
        rendered.download()
    }

    /// The render with these numbers of its lamp.
    pub(crate) fn render_lit(&self, numbers: &[f32]) -> Rendered<'_> {
        let mut rendered = Rendered::new(self);
        rendered.renderer.set_lamp_numbers(numbers).unwrap();
        rendered.forward();
        rendered.download()
    }

    /// The render and the status, with memory for this number of intersections, sufficient or not.
    pub(crate) fn render_within(&self, capacity: u32) -> (Rendered<'_>, Status) {
        let mut rendered = Rendered::new(self);
        rendered.renderer.set_intersection_capacity(capacity).unwrap();
        rendered.forward();
        let status = Status::from_words(&gpu().read(rendered.renderer.status()).unwrap());
        (rendered.download(), status)
    }
}

/// A setup, rendered.
pub(crate) struct Rendered<'a> {
    setup: &'a Setup,
    pub(crate) gaussians: DeviceGaussians,
    pub(crate) renderer: Renderer,
    /// (channels, H, W)
    pub(crate) render: Vec<f32>,
    /// (H, W)
    pub(crate) transmittances: Vec<f32>,
}

/// The results of the backward pass.
#[derive(Clone, PartialEq, Debug)]
pub(crate) struct Gradients {
    pub(crate) parameters: Vec<f32>,
    pub(crate) grad_norm_sums: Vec<f32>,
    pub(crate) visit_counts: Vec<u32>,
}

impl<'a> Rendered<'a> {
    /// Of all pixels together; as Adam is trained, of each pixel.
    pub(crate) fn norm(is_trained: bool) -> GradientNorm {
        GradientNorm { adds_pixels: is_trained, damping_weight: 0.7, damping_depth: 3.0 }
    }

    /// The statistics before the backward pass, which adds to them.
    pub(crate) const NORM_BEFORE: f32 = 0.5;
    pub(crate) const VISITS_BEFORE: u32 = 3;

    fn new(setup: &'a Setup) -> Self {
        let gaussians = setup.upload();
        let (gpu, settings) = (gpu(), setup.settings);
        let mut renderer = match setup.is_trained {
            true => Renderer::with_gradients(&gpu, settings, GradientKind::Colors, 0).unwrap(),
            false => Renderer::new(&gpu, settings).unwrap(),
        };
        renderer.reserve(setup.count, [&setup.camera]).unwrap();
        Self { setup, gaussians, renderer, render: vec![], transmittances: vec![] }
    }

    /// The render of a setup together with other Gaussians.
    pub(crate) fn in_context(setup: &'a Setup, context: &Gaussians) -> Self {
        let mut rendered = Self::new(setup);
        rendered.renderer.set_context(context).unwrap();
        rendered.renderer.reserve(setup.count, [&setup.camera]).unwrap();
        rendered.forward();
        rendered.download()
    }

    /// Only the forward pass; the flags of the status stay.
    pub(crate) fn forward(&mut self) {
        let Self { setup, gaussians, renderer, .. } = self;
        gpu()
            .run("forward", |pass| {
                renderer.forward(pass, &*gaussians, &setup.camera, &setup.options)
            })
            .unwrap();
    }

    fn download(mut self) -> Self {
        self.render = gpu().read(self.renderer.render()).unwrap();
        self.transmittances = gpu().read(self.renderer.transmittances()).unwrap();
        self
    }

    /// The gradients from that of the render, (channels, H, W).
    pub(crate) fn backward(&mut self, d_render: &[f32]) -> Gradients {
        let (gpu, Self { setup, gaussians, renderer, .. }) = (gpu(), &mut *self);
        let d_render = gpu.buffer("d_render", d_render).unwrap();
        let unwritten = vec![f32::NAN; setup.parameters.len()];
        let mut parameters = gpu.buffer("gradients", &unwritten).unwrap();
        let norms = vec![Self::NORM_BEFORE; setup.count];
        let mut grad_norm_sums = gpu.buffer("grad_norm_sums", &norms).unwrap();
        let visits = vec![Self::VISITS_BEFORE; setup.count];
        let mut visit_counts = gpu.buffer("visit_counts", &visits).unwrap();
        gpu.run("backward", |pass| {
            let gradients = render::Gradients {
                parameters: &mut parameters,
                grad_norm_sums: &mut grad_norm_sums,
                visit_counts: &mut visit_counts,
            };
            let Setup { camera, options, .. } = setup;
            renderer.backward(
                pass,
                &*gaussians,
                camera,
                options,
                Self::norm(setup.is_trained),
                &d_render,
                gradients,
            )
        })
        .unwrap();
        if setup.is_trained {
            parameters = self.completed(parameters);
        }
        let batches = Batches::new(&gpu, self.gaussians.layout.floats());
        Gradients {
            parameters: batches.read(&gpu, &parameters).unwrap(),
            grad_norm_sums: gpu.read(&grad_norm_sums).unwrap(),
            visit_counts: gpu.read(&visit_counts).unwrap(),
        }
    }

    /// The gradients that a step of Adam takes, by its first moments, from those that the renderer writes.
    fn completed(&mut self, written: Buffer<f32>) -> Buffer<f32> {
        let (gpu, Self { setup, gaussians, .. }) = (gpu(), self);
        let layout = gaussians.layout;
        let mut moments = Moments::zeros(&gpu, layout.floats().total()).unwrap();
        let camera = [(&Patch::from(&setup.camera)).into()];
        let (camera, status) =
            (gpu.buffer("camera", &camera).unwrap(), gpu.zeros("status", 1).unwrap());
        gpu.run("adam", |pass| {
            let rates = &LearningRates::uniform(1e-3);
            let step = GaussianStep {
                adam: AdamStep { step: 1, rates, status: &status },
                sh_degree: setup.options.sh_degree,
                camera: (&camera, 0),
            };
            let buffers = AdamBuffers {
                parameters: gaussians.parameters.slice_mut(),
                gradients: written.slice(),
                moments: moments.slice_mut(),
            };
            Adam::new(&gpu)?.record_gaussians(pass, step, layout, buffers)
        })
        .unwrap();
        let Moments::Single { first, .. } = &moments else { panic!("{moments:?}") };
        let of = |moment: &f32| (f64::from(*moment) / (1.0 - BETA1)) as f32;
        let gradients: Vec<f32> = gpu.read(first).unwrap().iter().map(of).collect();
        gpu.buffer("completed", &gradients).unwrap()
    }
}

/// Features with this number of channels, including the three of colour.
pub(crate) fn features(channels: usize) -> Features {
    let features = Features { depth: channels > 3, structure: channels > 4, ..Features::NONE };
    let features = if channels > 5 { Features::ALL } else { features };
    assert_eq!(features.channels(), channels);
    features
}

/// A tile of this size, shared by this number of subgroups.
pub(crate) fn tile_of((size, subgroups): ([u32; 2], u32)) -> Tile {
    Tile { subgroups, ..size.into() }
}

/// A typical fisheye, with values that f32 represents.
pub(crate) fn fisheye() -> CameraModel {
    let coefficients = [0.05f32, -0.02, 0.006, -0.001].map(f64::from);
    CameraModel::Fisheye(KannalaBrandt { coefficients })
}

/// A lamp beside the camera whose every number counts.
pub(crate) fn lamp() -> Lamp {
    Lamp {
        position: [0.1, -0.2, 0.05],
        axis: [0.1, 0.2],
        ambient: 0.1,
        exponent: 1.7,
        falloffs: [3.0, 0.5],
        reference_distance: 2.0,
        slope: 0.45,
        black: 0.07,
        reach: 0.6,
    }
}

/// Edge cases of size, channel count, tile and SH degree (stored, in use) for the kernels; with many channels, colours
/// are raw; every second variant is antialiased, every third lit by a lamp.
pub(crate) fn variants() -> Vec<Setup> {
    type Row = (usize, [u32; 2], [u32; 2], usize, ([u32; 2], u32));
    let rows: [Row; 11] = [
        (0, [33, 17], [0, 0], 3, ([16, 8], 1)),
        (1, [16, 16], [0, 0], 3, ([16, 16], 1)),
        (63, [50, 37], [1, 1], 4, ([16, 8], 1)),
        (64, [64, 48], [2, 1], 11, ([16, 4], 1)),
        (65, [65, 31], [3, 0], 3, ([8, 8], 1)),
        (65, [40, 41], [3, 2], 11, ([8, 8], 1)),
        (300, [131, 77], [3, 3], 3, ([16, 8], 1)),
        (300, [70, 53], [1, 1], 3, ([16, 16], 4)),
        (120, [51, 37], [2, 2], 11, ([16, 16], 2)),
        (64, [50, 37], [1, 1], 3, ([16, 8], 1)),
        (200, [66, 52], [2, 1], 4, ([16, 16], 1)),
    ];
    /// The variants from this one on have a fisheye.
    const PINHOLES: usize = 9;
    let build = |(i, (count, size, [stored, used], channels, tile)): (usize, Row)| {
        let shape = Shape { sh_degree: stored, features: features(channels) };
        let model = if i < PINHOLES { CameraModel::Pinhole } else { fisheye() };
        let mut setup = Setup::seen_by(model, count, size, shape, count as u64);
        setup.options.sh_degree = used;
        setup.settings.raw_colors = channels > 4;
        setup.settings.antialiased = i % 2 == 1;
        setup.settings.lamp = (i % 3 == 2).then(lamp);
        // A device replaces tiles that it does not support by its own.
        setup.settings.tile =
            Some(tile_of(tile)).filter(|&tile| gpu().properties().suits_tile(tile));
        setup
    };
    rows.into_iter().enumerate().map(build).collect()
}
