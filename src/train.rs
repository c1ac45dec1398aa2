//! Training: each step renders one view and compares it with its pseudo-GT.

mod best;
mod cache;
mod checkpoint;
mod config;
mod context;
mod decisions;
mod depth_seeding;
pub mod diagnose;
mod difference;
mod early_stopping;
mod encoding;
mod epochs;
mod exposures;
mod first_gaussians;
mod growth;
mod lamp;
mod layers;
mod masks;
mod memory;
mod model;
mod networks;
mod parts;
mod passes;
mod patches;
mod paths;
mod planned;
mod precision;
mod preset;
mod reference;
mod rendered;
pub mod settings;
mod start;
mod submission;
mod supervision;
mod target_views;
mod terms;
mod views;

use nightsplat_core::camera::{Camera, TrainingFrame};
use nightsplat_photographs::dataset::{Dataset, Fingerprint};
use nightsplat_photographs::tone::SceneLaw;

use crate::gpu::CheckReport;
use crate::gpu::{Gpu, PassTime, Recorder};
use crate::loss::Term;
use crate::splats::optimizer::{Adam, AdamStep, FiniteCheck, GaussianStep, LearningRates};
use crate::splats::render::{Damping, Gradients, RenderOptions, Renderer};
use crate::splats::scene::{ATTRIBUTES, Gaussians, ModelFacts};
use crate::splats::smoothing::SmoothingFloor;
use crate::{Error, Result, splats};
pub use cache::CacheSize;
pub use checkpoint::check_checkpoint;
pub use config::{
    AntialiasingConfig, Background, CheckConfig, DensityConfig, ExposureConfig, Freeze, LampConfig,
    LampRates, NotFinite, StopConfig, TrainConfig,
};
use context::Initial;
use early_stopping::Convergence;
pub use early_stopping::{EndReason, Ended};
pub(crate) use exposures::known_stops;
use growth::Growth;
use lamp::LampLearning;
pub use layers::{Origin, Settings, SettingsLayer, values};
pub use memory::MemoryEstimate;
use model::TrainedModel;
pub use networks::Networks;
pub use parts::{ModelConfig, ModelName, NetworkRates, Part};
use passes::background;
pub use planned::{PlanSource, PlannedRun, RequestedSettings, diagnosed};
pub use precision::{PhotographBits, PrecisionConfig};
pub use preset::Preset;
pub use reference::reference;
pub use rendered::Rendered;
use submission::Submissions;
use supervision::Supervision;

/// The streams of random numbers that training draws from, one per purpose.
mod streams {
    pub(super) const POINTS: u64 = 1;
    pub(super) const BACKGROUND: u64 = 2;
    pub(super) const VIEWS: u64 = 3;
    pub(super) const DENSITY: u64 = 4;
    pub(super) const FEATURES: u64 = 5;
    pub(super) const NETWORKS: u64 = 6;
    pub(super) const CROPS: u64 = 7;
    pub(super) const BOXES: u64 = 8;
    pub(super) const FILL: u64 = 9;
}

/// The interval of the smoothing floor, which visits every camera; scales change by at most 8 % in between.
const FLOOR_STEPS: u64 = 16;

/// The result of one step.
#[derive(Clone, Debug)]
pub struct StepReport {
    /// The number of the step, from 1.
    pub step: u64,
    /// The name of the view.
    pub view: String,
    /// The loss: the weighted sum of the terms.
    pub loss: f64,
    /// The unweighted terms of the model's loss.
    pub terms: Vec<(Term, f64)>,
    /// The number of Gaussians rendered.
    pub gaussians: usize,
    /// Its share of the submission's time, in milliseconds.
    pub milliseconds: f64,
}

impl StepReport {
    /// The value of a term; 0 if the model does not have it.
    pub fn term(&self, term: Term) -> f64 {
        self.terms.iter().find(|(name, _)| *name == term).map_or(0.0, |&(_, value)| value)
    }
}

/// A model in training. [`crate::results::run::train`] trains one into a run directory.
///
/// ```no_run
/// use nightsplat::{Dataset, DeviceChoice, Gpu, TrainConfig, Trainer};
///
/// let config = TrainConfig { steps: 500, ..TrainConfig::default() };
/// let gpu = Gpu::new(&DeviceChoice::Best)?;
/// let dataset = Dataset::load("photos", &config.load_options())?;
/// let mut trainer = Trainer::new(&gpu, config.clone(), &dataset)?;
/// while !trainer.has_ended() {
///     for report in trainer.advance(config.steps)? {
///         println!("step {}: loss {:.4}", report.step, report.loss);
///     }
/// }
/// trainer.model()?.save("model.ply")?;
/// # Ok::<(), nightsplat::Error>(())
/// ```
#[derive(Debug)]
pub struct Trainer {
    gpu: Gpu,
    config: TrainConfig,
    /// The dataset's fingerprint.
    fingerprint: Fingerprint,
    /// The frame of all coordinates on the device.
    frame: TrainingFrame,
    /// The scene's extent, in units of the frame.
    extent: f64,
    /// The curve from the photographs to the model's colours, where it can be stated.
    law: Option<SceneLaw>,
    /// Steps done.
    step: u64,
    supervision: Supervision,
    model: TrainedModel,
    renderer: Renderer,
    optimizer: Optimizer,
    growth: Growth,
    convergence: Convergence,
    submissions: Submissions,
    /// Bytes on the device that do not depend on the number of Gaussians and intersections.
    fixed_bytes: f64,
}

/// The optimizer and the check of the parameters.
#[derive(Debug)]
struct Optimizer {
    adam: Adam,
    finite: FiniteCheck,
    /// `None`: off.
    floor: Option<SmoothingFloor>,
    /// `None`: off.
    lamp: Option<LampLearning>,
    /// The step of the last check of the parameters.
    checked: u64,
}

impl Trainer {
    /// Uploads the training views, measures them and places the first Gaussians, or those of [`TrainConfig::init`].
    ///
    /// # Errors
    /// The configuration is invalid, the initial model does not fit it, or the device is out of memory or lost.
    pub fn new(gpu: &Gpu, config: TrainConfig, dataset: &Dataset) -> Result<Self> {
        let initial = Initial::load(&config, dataset)?;
        Self::on_patches(gpu, config, dataset, &initial)
    }

    /// [`Trainer::new`] with given Gaussians to start from.
    ///
    /// # Errors
    /// Those of [`Trainer::new`], or the shape of the Gaussians differs from the configured model's.
    pub fn from_gaussians(
        gpu: &Gpu,
        config: TrainConfig,
        dataset: &Dataset,
        gaussians: &Gaussians,
    ) -> Result<Self> {
        let initial = Initial { gaussians: Some(gaussians.clone()), context: None };
        Self::on_patches(gpu, config, dataset, &initial)
    }

    /// The number of steps done.
    pub fn steps_done(&self) -> u64 {
        self.step
    }

    /// The number of Gaussians.
    pub fn gaussian_count(&self) -> usize {
        self.model.count()
    }

    /// Reads back the Gaussians, in the dataset's world as far as f32 holds it, with the SH degree reached so far.
    ///
    /// # Errors
    /// The device was lost.
    pub fn gaussians(&self) -> Result<Gaussians> {
        Ok(self.gaussians_in_frame()?.to_world(&self.frame))
    }

    /// The Gaussians with what a renderer must know of them.
    ///
    /// # Errors
    /// The device was lost.
    pub fn model(&self) -> Result<splats::model::Model> {
        Ok(self.model_of(&self.gaussians_in_frame()?))
    }

    /// Gaussians in [`Trainer::frame`] with what a renderer must know of them in the dataset's world.
    pub(crate) fn model_of(&self, in_frame: &Gaussians) -> splats::model::Model {
        let facts = ModelFacts { law: self.law, ..self.config.facts(&self.frame) };
        splats::model::Model::new(in_frame.to_world(&self.frame), &facts)
    }

    /// The Gaussians in [`Trainer::frame`], bit for bit as trained.
    #[doc(hidden)]
    pub fn gaussians_in_frame(&self) -> Result<Gaussians> {
        self.model.download(&self.gpu)
    }

    /// The dataset's fingerprint.
    pub(crate) fn fingerprint(&self) -> &Fingerprint {
        &self.fingerprint
    }

    /// The frame in which the Gaussians are trained.
    #[doc(hidden)]
    pub fn frame(&self) -> &TrainingFrame {
        &self.frame
    }

    /// Reserves memory for this number of intersections of a view.
    #[doc(hidden)]
    pub fn set_intersection_capacity(&mut self, intersections: u32) -> Result<()> {
        self.renderer.set_intersection_capacity(intersections)
    }

    /// Trains up to `until`, or for about half a second, and reports every step; waits until the device is done. Steps
    /// to be checked ([`TrainConfig::check`]) run one at a time.
    ///
    /// # Errors
    /// [`Error::Usage`] if the run has ended, [`Error::NotFinite`] if a loss term or gradient is not finite and
    /// [`StopConfig::not_finite`] says to stop, [`Error::TileLimit`] if a tile has more splats than the device can
    /// process, [`Error::Disagrees`] if a checked step differs from its references and [`TrainConfig::check`] says to
    /// stop, or the device is out of memory or lost.
    pub fn advance(&mut self, until: u64) -> Result<Vec<StepReport>> {
        let _phase = tracing::info_span!("steps").entered();
        if until > self.step && self.step < self.config.steps && self.has_ended() {
            return Err(Error::Usage(format!(
                "the run has ended at step {}, before step {until}: the held-out views have converged \
                 (`Trainer::has_ended`)",
                self.step
            )));
        }
        match (self.step + 1).checked_next_multiple_of(self.config.check.every) {
            Some(checked) if checked > until => self.submit_steps(until),
            Some(checked) if checked > self.step + 1 => self.submit_steps(checked - 1),
            Some(_) if self.step < until.min(self.last_step()) => self.agreeing_step(),
            _ => self.submit_steps(until),
        }
    }

    /// Trains one step with every pass checked; a difference is an error or a warning, as configured.
    fn agreeing_step(&mut self) -> Result<Vec<StepReport>> {
        let (reports, checks) = self.check_step();
        match checks.agree() {
            Err(difference) if self.config.check.stops => return Err(difference),
            Err(difference) => tracing::warn!("step {}: {difference}", self.step),
            Ok(()) => {}
        }
        reports
    }

    /// Trains one step with every pass checked ([`Gpu::checked`]), density control included. The model has the same
    /// bits as after [`Trainer::advance`]; a step that must be redone with more memory is not reported.
    pub fn check_step(&mut self) -> (Result<Vec<StepReport>>, CheckReport) {
        let next = self.step + 1;
        self.gpu.clone().checked(|| self.submit_steps(next))
    }

    /// Trains one step and measures the time of each pass on the device.
    ///
    /// # Errors
    /// Those of [`Trainer::advance`]. A step that overflows its memory is not counted; the next [`Trainer::advance`]
    /// redoes it.
    pub fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        self.timed_step(|gpu, trainer, step| {
            gpu.profile("step", |pass| trainer.record_step(pass, step, 0))
        })
    }

    /// Trains one step and measures its milliseconds on the device, as a whole.
    pub(crate) fn profile_whole_step(&mut self) -> Result<f64> {
        self.timed_step(|gpu, trainer, step| {
            gpu.profile_whole("step", |pass| trainer.record_step(pass, step, 0))
        })
    }

    fn timed_step<T>(&mut self, run: impl FnOnce(&Gpu, &mut Self, u64) -> Result<T>) -> Result<T> {
        let step = self.step + 1;
        self.allocate_sh_degree()?;
        self.supervision.views.make_resident(&self.config, step..=step)?;
        let times = run(&self.gpu.clone(), self, step)?;
        if self.gpu.read(self.renderer.status())?.first() == Some(&0) {
            self.step = step;
        }
        Ok(times)
    }

    /// Records a step: render a view, compare it with its pseudo-GT, backward pass, update.
    fn record_step(&mut self, pass: &mut Recorder<'_>, step: u64, slot: u32) -> Result<()> {
        let schedule = &self.config.schedule;
        let view = self.view_id(step);
        let cooldown_factor = self.cooldown_factor(step);
        let is_floored = step.is_multiple_of(FLOOR_STEPS) || step == self.last_step();
        let rates = self.learning_rates(step);
        let options = RenderOptions {
            sh_degree: self.sh_degree(step),
            background: background(&self.config, step),
        };
        let damping = Damping { weight: schedule.damping_weight(step), depth: self.extent as f32 };
        let Self { gpu, supervision, model, renderer, optimizer, .. } = self;

        renderer.forward(pass, &model.gaussians, supervision.views.viewpoint(view), &options)?;
        supervision.compare(pass, step, view, model.shape().features, renderer, slot)?;
        renderer.backward(
            pass,
            &model.gaussians,
            supervision.views.viewpoint(view),
            &options,
            damping,
            &supervision.d_render,
            Gradients {
                parameters: &mut model.gradients,
                grad_norm_sums: &mut model.grad_norm_sums,
                visit_counts: &mut model.visit_counts,
            },
        )?;
        supervision.regularise(pass, model, renderer, slot)?;
        let status = renderer.status();
        let gaussian_step = GaussianStep {
            adam: AdamStep { step, rates: &rates, status },
            sh_degrees: [model.shape().sh_degree, options.sh_degree],
            camera: renderer.camera_of(&supervision.views.viewpoint(view)),
        };
        model.update(gpu, pass, &optimizer.adam, gaussian_step, renderer.gradient_kind())?;
        if let Some(floor) = optimizer.floor.as_ref().filter(|_| is_floored) {
            floor.record(pass, &mut model.gaussians, status)?;
        }
        supervision.update(pass, &optimizer.adam, step, cooldown_factor, status)?;
        optimizer.update_lamp(pass, renderer, step, cooldown_factor)
    }

    /// The networks, if the model has any.
    #[doc(hidden)]
    pub fn networks(&mut self) -> Option<&mut Networks> {
        self.supervision.networks()
    }

    /// The learning rates of a step, including the cooldown.
    #[doc(hidden)]
    pub fn learning_rates(&self, step: u64) -> LearningRates {
        let rates = self.config.schedule.learning_rates(step, self.extent);
        let mut rates = rates.scaled(self.cooldown_factor(step));
        for spec in &ATTRIBUTES {
            if self.config.freeze.as_ref().is_some_and(|freeze| freeze.has(spec.attribute)) {
                rates[spec.attribute] = 0.0;
            }
        }
        rates
    }

    /// Renders the model from `camera`, with the SH degree reached so far, over a black background.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn render(&mut self, camera: &Camera) -> Result<Rendered> {
        let camera = self.frame.camera(camera);
        self.render_of_degree(&camera, self.sh_degree_in_use())
    }

    /// [`Trainer::render`] in even light, as [`Trainer::model`] is, if the model has a lamp.
    #[doc(hidden)]
    pub fn render_in_even_light(&mut self, camera: &Camera) -> Result<Rendered> {
        self.renderer.set_even_light(true);
        let rendered = self.render(camera);
        self.renderer.set_even_light(false);
        rendered
    }

    /// [`Trainer::render`] for a camera in the training frame.
    fn render_of_degree(&mut self, camera: &Camera, sh_degree: u32) -> Result<Rendered> {
        let options = RenderOptions { sh_degree, background: [0.0; 3] };
        let gaussians = &self.model.gaussians;
        let networks = self.supervision.networks();
        Rendered::new(&mut self.renderer, gaussians, camera, &options, networks)
    }
}
