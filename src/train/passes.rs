//! The kernels of a step.

use nightsplat_core::random::Stream;
use nightsplat_models::gaussians::Shape;
use nightsplat_photographs::dataset::Dataset;

use super::config::{Background, DensityConfig, TrainConfig};
use super::streams;
use crate::Result;
use crate::gpu::Gpu;
use crate::loss::Losses;
use crate::splats::batches::GradientKind;
use crate::splats::densify::{Densifier, DensifySettings};
use crate::splats::optimizer::{Adam, FiniteCheck};
use crate::splats::render::{RenderSettings, Renderer};
use crate::splats::smoothing::SmoothingFloor;

/// Kernels that depend only on the device and the settings.
pub(super) struct TrainKernels {
    pub(super) renderer: Renderer,
    pub(super) losses: Losses,
    pub(super) adam: Adam,
    pub(super) finite: FiniteCheck,
    pub(super) floor: Option<SmoothingFloor>,
    pub(super) densifier: Densifier,
}

impl TrainKernels {
    pub(super) fn new(gpu: &Gpu, config: &TrainConfig, dataset: &Dataset) -> Result<Self> {
        let (rest, settings) = (config.precision.rest, config.render_settings());
        let shape = Shape { sh_degree: first_sh_degree(config), ..settings.shape };
        Ok(Self {
            renderer: Renderer::with_gradients(
                gpu,
                RenderSettings { rest, shape, ..settings },
                GradientKind::on(gpu, [rest, config.precision.moments]),
                config.frozen_columns(),
            )?,
            losses: Losses::new(gpu, &config.loss())?,
            adam: Adam::with_frozen(gpu, config.frozen_columns())?,
            finite: FiniteCheck::new(gpu)?,
            floor: floor(gpu, config, dataset)?,
            densifier: densifier(gpu, config, dataset)?,
        })
    }
}

/// The smoothing floor of the training views, in the frame, if it is on.
fn floor(gpu: &Gpu, config: &TrainConfig, dataset: &Dataset) -> Result<Option<SmoothingFloor>> {
    let (variance, near) = (config.antialiasing.smoothing, config.render_settings().near);
    if variance == 0.0 {
        return Ok(None);
    }
    let frame = config.frame.unwrap_or_default();
    let cameras = dataset.train_views().map(|view| frame.camera(&view.camera));
    Ok(Some(SmoothingFloor::new(gpu, variance, near, &cameras.collect::<Vec<_>>())?))
}

/// Density control in the frame, for the cameras of the training views.
fn densifier(gpu: &Gpu, config: &TrainConfig, dataset: &Dataset) -> Result<Densifier> {
    let frame = config.frame.unwrap_or_default();
    let cameras = dataset.train_views().map(|view| frame.camera(&view.camera));
    let DensityConfig { control, gradient_threshold, split_scale, .. } = config.density;
    let settings = DensifySettings {
        control,
        gradient_threshold: gradient_threshold.unwrap_or(control.strategy().gradient_threshold),
        split_scale: split_scale * config.extent_of(dataset) * frame.scale,
        min_opacity: config.density.min_opacity,
        max_gaussians: config.max_gaussians,
        near: config.render_settings().near.into(),
        seed: Stream::new(config.seed, streams::DENSITY).bits(0),
    };
    Densifier::new(gpu, settings, &cameras.collect::<Vec<_>>())
}

/// The SH degree of the first step.
pub(super) fn first_sh_degree(config: &TrainConfig) -> u32 {
    config.sh_degree_at(1, config.sh_degree)
}

/// The background of a step.
pub(super) fn background(config: &TrainConfig, step: u64) -> [f32; 3] {
    match config.background {
        Background::Black => [0.0; 3],
        Background::Random => {
            let stream = Stream::new(config.seed, streams::BACKGROUND);
            std::array::from_fn(|c| stream.uniform(3 * step + c as u64) as f32)
        }
    }
}
