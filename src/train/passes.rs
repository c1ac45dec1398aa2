//! The kernels of a step.

use std::panic::resume_unwind;
use std::thread;

use nightsplat_core::random::Stream;
use nightsplat_core::watch::Watch;
use nightsplat_models::gaussians::Shape;
use nightsplat_photographs::dataset::Dataset;

use super::config::{Background, DensityConfig, TrainConfig};
use super::streams;
use crate::gpu::Gpu;
use crate::loss::Losses;
use crate::splats::batches::GradientKind;
use crate::splats::densify::{Densifier, DensifySettings};
use crate::splats::optimizer::{Adam, FiniteCheck};
use crate::splats::render::{RenderSettings, Renderer};
use crate::splats::smoothing::SmoothingFloor;
use crate::targets::pseudo_gt::PseudoGt;
use crate::{Error, Result};

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
        Ok(Self {
            renderer: renderer(gpu, config)?,
            losses: Losses::new(gpu, &config.loss())?,
            adam: Adam::with_frozen(gpu, config.frozen_columns())?,
            finite: FiniteCheck::new(gpu)?,
            floor: floor(gpu, config, dataset)?,
            densifier: densifier(gpu, config, dataset)?,
        })
    }
}

/// Does other work while another thread compiles the kernels that need no dataset: as long as the work takes, and one
/// kernel longer. [`TrainKernels::new`] finds them, unless a plan asks for others. An error of the work comes first.
pub(super) fn while_compiling<T>(
    gpu: &Gpu,
    config: &TrainConfig,
    work: impl FnOnce() -> Result<T>,
) -> Result<T> {
    let compile = || {
        PseudoGt::new(gpu, &config.tone)?.compile()?;
        renderer(gpu, config)?;
        Losses::new(gpu, &config.loss())?.compile()?;
        Adam::with_frozen(gpu, config.frozen_columns())?;
        FiniteCheck::new(gpu).map(drop)
    };
    let watch = Watch::default();
    thread::scope(|scope| {
        let beside = scope.spawn(|| watch.within(compile));
        let done = work();
        watch.stop();
        match beside.join().unwrap_or_else(|panic| resume_unwind(panic)) {
            Ok(()) | Err(Error::Halted { .. }) => done,
            Err(error) => done.and(Err(error)),
        }
    })
}

fn renderer(gpu: &Gpu, config: &TrainConfig) -> Result<Renderer> {
    let (rest, settings) = (config.precision.rest, config.render_settings());
    let shape = Shape { sh_degree: first_sh_degree(config), ..settings.shape };
    Renderer::with_gradients(
        gpu,
        RenderSettings { rest, shape, ..settings },
        GradientKind::on(gpu, [rest, config.precision.moments]),
        config.frozen_columns(),
    )
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

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::*;
    use crate::gpu::DeviceChoice;
    use crate::gpu::testing::compiled;

    #[test]
    fn kernels_are_compiled_beside_work_and_no_more_of_them_once_it_fails() {
        // A device of its own: another test's would have them.
        let gpu = Gpu::new(&DeviceChoice::Best).unwrap();
        let before = compiled(&gpu);
        let failed = while_compiling::<()>(&gpu, &TrainConfig::default(), || {
            let begin = Instant::now();
            while compiled(&gpu) == before {
                assert!(begin.elapsed() < Duration::from_secs(60));
                thread::yield_now();
            }
            Err(Error::Usage("no such dataset".to_owned()))
        });
        assert_eq!(failed.unwrap_err().to_string(), "no such dataset");
        let some = compiled(&gpu) - before;
        renderer(&gpu, &TrainConfig::default()).unwrap();
        assert!((1..compiled(&gpu) - before).contains(&some), "{some}");
    }
}
