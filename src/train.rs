//! Training: one view a step, its pseudo-GT the target, the Gaussians what is learned.

mod config;
mod model;
mod overrides;
mod views;

use std::time::Instant;

use glam::UVec2;

use crate::camera::Camera;
use crate::dataset::Dataset;
use crate::densify::{Densifier, DensifySettings};
use crate::gpu::{Buffer, Gpu, PassTime, Recorder};
use crate::image::Image;
use crate::loss::{Loss, LossInputs, LossLog, StepLoss};
use crate::optimizer::{Adam, AdamBuffers};
use crate::pseudo_gt::PseudoGt;
use crate::random::Stream;
use crate::render::{Damping, Gradients, RenderOptions, RenderSettings, Renderer, Status};
use crate::scene::{Gaussians, width};
use crate::{Error, Result};

pub use config::{Background, DensityConfig, TrainConfig};
use model::Model;
use views::Views;

/// Steps that one submission holds at most: recording and reading back cost once for all of them.
const STEPS_PER_SUBMISSION: u64 = 8;

/// The streams of random numbers that training draws from, one per purpose.
mod streams {
    pub(super) const POINTS: u64 = 1;
    pub(super) const BACKGROUND: u64 = 2;
    pub(super) const VIEWS: u64 = 3;
    pub(super) const DENSITY: u64 = 4;
    pub(super) const FEATURES: u64 = 5;
}

/// What one step did.
#[derive(Clone, Debug)]
pub struct StepReport {
    /// Counted from 1.
    pub step: u64,
    /// The view it trained on.
    pub view: String,
    /// (1 - w) L1 + w (1 - SSIM).
    pub loss: f64,
    /// Mean |render - target|.
    pub l1: f64,
    /// Mean SSIM of render and target; 0 where its weight is 0.
    pub ssim: f64,
    /// The number of Gaussians it rendered.
    pub gaussians: usize,
    /// Its share of the time its submission took, in milliseconds.
    pub milliseconds: f64,
}

/// A model in training, and all that its steps need.
#[derive(Debug)]
pub struct Trainer {
    gpu: Gpu,
    config: TrainConfig,
    extent: f64,
    /// Steps done.
    step: u64,
    views: Views,
    model: Model,
    renderer: Renderer,
    loss: Loss,
    adam: Adam,
    densifier: Densifier,
    d_render: Buffer<f32>,
    log: Buffer<StepLoss>,
}

impl Trainer {
    /// Uploads the training views, takes their statistics and places the first Gaussians.
    ///
    /// # Errors
    /// The configuration makes no sense, or the device is out of memory or lost.
    pub fn new(gpu: &Gpu, config: TrainConfig, dataset: &Dataset) -> Result<Self> {
        config.check()?;
        let mut pseudo_gt = PseudoGt::new(gpu, config.tone)?;
        let views = Views::upload(gpu, &mut pseudo_gt, dataset)?;
        let gaussians = views.initial_gaussians(gpu, &pseudo_gt, dataset, &config)?;
        let settings = RenderSettings { shape: gaussians.shape, ..RenderSettings::default() };
        let sizes = views.sizes();
        let pixels = sizes.iter().map(|size| size.x as usize * size.y as usize).max();
        let mut trainer = Self {
            gpu: gpu.clone(),
            extent: dataset.extent(),
            step: 0,
            views,
            model: Model::upload(gpu, &gaussians)?,
            renderer: Renderer::new(gpu, settings)?,
            loss: Loss::new(gpu, config.tone.curve.constant(), config.ssim_weight, &sizes)?,
            adam: Adam::new(gpu)?,
            densifier: Densifier::new(gpu, density(&config, dataset.extent()))?,
            d_render: gpu.uninit("d_render", 3 * pixels.unwrap_or_default())?,
            log: gpu.uninit("loss_log", STEPS_PER_SUBMISSION as usize)?,
            config,
        };
        trainer.reserve()?;
        Ok(trainer)
    }

    /// Steps done so far.
    pub fn steps_done(&self) -> u64 {
        self.step
    }

    /// The number of Gaussians.
    pub fn gaussian_count(&self) -> usize {
        self.model.count()
    }

    /// The Gaussians as they are now, on the host.
    ///
    /// # Errors
    /// The device was lost.
    pub fn gaussians(&self) -> Result<Gaussians> {
        self.model.download(&self.gpu)
    }

    /// Sets how many intersections a view may have before memory has to grow, where that is known better than guessed.
    ///
    /// # Errors
    /// The device is out of memory.
    pub fn set_intersection_capacity(&mut self, intersections: u32) -> Result<()> {
        self.renderer.set_intersection_capacity(intersections)
    }

    /// Trains up to `until`, one submission's worth at most, and reports every step done.
    ///
    /// # Errors
    /// [`Error::NotFinite`] where a loss term is NaN, or the device is out of memory or lost.
    pub fn advance(&mut self, until: u64) -> Result<Vec<StepReport>> {
        let first = self.step + 1;
        let until = until.min(self.config.steps).min(self.step + STEPS_PER_SUBMISSION);
        // A submission ends where density control changes the number of Gaussians.
        let last = (first..until).find(|&step| self.densifies_at(step)).unwrap_or(until);
        if last < first {
            return Ok(vec![]);
        }
        let begin = Instant::now();
        let gpu = self.gpu.clone();
        let mut downloads = None;
        gpu.run("steps", |pass| {
            for step in first..=last {
                self.record_step(pass, step, (step - first) as u32)?;
            }
            downloads = Some((pass.download(&self.log)?, pass.download(self.renderer.status())?));
            Ok(())
        })?;
        let Some((log, status)) = downloads else { return Ok(vec![]) };
        let (log, status) = (log.wait()?, Status::from_words(&status.wait()?));
        // The steps from the first failed one on have changed nothing.
        let done =
            log.iter().take((last - first + 1) as usize).take_while(|l| l.status == 0).count();
        let milliseconds = begin.elapsed().as_secs_f64() * 1e3 / done.max(1) as f64;
        let reports = (first..)
            .zip(&log[..done])
            .map(|(step, loss)| self.report(step, loss, milliseconds))
            .collect();
        self.step += done as u64;
        if done > 0 && self.densifies_at(self.step) {
            let changed = self.model.densify(&gpu, &mut self.densifier, self.step)?;
            tracing::debug!("step {}: {changed:?}", self.step);
            self.reserve()?;
        }
        if status.overflowed {
            self.renderer.grow(status.intersections)?;
            let renderer = &mut self.renderer;
            gpu.run("clear_status", |pass| {
                renderer.clear_status(pass);
                Ok(())
            })?;
        } else if status.not_finite {
            let step = self.step + 1;
            let what = if log[done].l1.is_finite() { "SSIM" } else { "L1" };
            let view = self.views.of_step(self.config.seed, step).name.clone();
            return Err(Error::NotFinite { step, view, what: what.to_owned() });
        }
        Ok(reports)
    }

    /// Trains one step and reports how long each of its passes took on the device.
    ///
    /// # Errors
    /// As [`Trainer::advance`]; a step that overflows its memory is not counted, the next [`Trainer::advance`] redoes it.
    pub fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        let step = self.step + 1;
        let times = self.gpu.clone().profile("step", |pass| self.record_step(pass, step, 0))?;
        if self.gpu.read(self.renderer.status())?.first() == Some(&0) {
            self.step = step;
        }
        Ok(times)
    }

    /// The algorithm: render a view, compare it with its pseudo-GT, go back, update.
    fn record_step(&mut self, pass: &mut Recorder<'_>, step: u64, slot: u32) -> Result<()> {
        let schedule = &self.config.schedule;
        let view = self.views.of_step(self.config.seed, step);
        let options = RenderOptions {
            sh_degree: schedule.sh_degree(step, self.config.sh_degree),
            background: background(&self.config, step),
        };
        let damping = Damping { weight: schedule.damping_weight(step), depth: self.extent as f32 };
        let size = UVec2::new(view.camera.width, view.camera.height);
        let model = &mut self.model;

        self.renderer.forward(pass, &model.gaussians.parameters, &view.camera, &options)?;
        let (render, status) = self.renderer.render_and_status();
        self.loss.record(
            pass,
            LossInputs { size, render, low: &view.image, tone: &view.tone },
            &mut self.d_render,
            LossLog { log: &mut self.log, slot, status, not_finite_flag: Status::NOT_FINITE },
        )?;
        self.renderer.backward(
            pass,
            &model.gaussians.parameters,
            &view.camera,
            &options,
            damping,
            &self.d_render,
            Gradients {
                parameters: &mut model.gradients,
                grad_norm_sums: &mut model.grad_norm_sums,
                visit_counts: &mut model.visit_counts,
            },
        )?;
        // Coefficients that are not in use yet have no gradient and no moments: nothing to update.
        let (columns, features) = (model.gaussians.column_count, model.gaussians.feature_count);
        let columns = if options.sh_degree == 0 { width(0) as u32 + features } else { columns };
        self.adam.record(
            pass,
            step,
            &schedule.learning_rates(step, self.extent),
            [model.gaussians.count, columns, features],
            AdamBuffers {
                parameters: &mut model.gaussians.parameters,
                gradients: &model.gradients,
                moments: &mut model.gaussians.moments,
                status: self.renderer.status(),
            },
        )
    }

    /// Renders what `camera` sees, with every SH degree trained so far, before a black background.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn render(&mut self, camera: &Camera) -> Result<Image> {
        let options = RenderOptions {
            sh_degree: self.config.schedule.sh_degree(self.step, self.config.sh_degree),
            background: [0.0; 3],
        };
        self.renderer.reserve(self.model.count(), [camera])?;
        self.renderer.render_image(&self.model.gaussians.parameters, camera, &options)
    }

    /// Density control acts after this step. Never so late that the run ends before what it added has settled.
    fn densifies_at(&self, step: u64) -> bool {
        let schedule = &self.config.schedule;
        schedule.densifies_at(step) && step + schedule.densify_interval <= self.config.steps
    }

    fn reserve(&mut self) -> Result<()> {
        self.renderer.reserve(self.model.count(), self.views.cameras())
    }

    fn report(&self, step: u64, loss: &StepLoss, milliseconds: f64) -> StepReport {
        let (l1, ssim, weight) =
            (f64::from(loss.l1), f64::from(loss.ssim), self.config.ssim_weight);
        StepReport {
            step,
            view: self.views.of_step(self.config.seed, step).name.clone(),
            loss: (1.0 - weight) * l1 + weight * (1.0 - ssim),
            l1,
            ssim,
            gaussians: self.model.count(),
            milliseconds,
        }
    }
}

/// Density control in world units.
fn density(config: &TrainConfig, extent: f64) -> DensifySettings {
    DensifySettings {
        gradient_threshold: config.density.gradient_threshold,
        split_scale: config.density.split_scale * extent,
        min_opacity: config.density.min_opacity,
        max_gaussians: config.max_gaussians,
        seed: Stream::new(config.seed, streams::DENSITY).bits(0),
    }
}

/// The background of a step.
fn background(config: &TrainConfig, step: u64) -> [f32; 3] {
    match config.background {
        Background::Black => [0.0; 3],
        Background::Random => {
            let stream = Stream::new(config.seed, streams::BACKGROUND);
            std::array::from_fn(|c| stream.uniform(3 * step + c as u64) as f32)
        }
    }
}
