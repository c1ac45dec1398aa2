//! A model in training: each step renders one view and compares it with its pseudo-GT.

use std::sync::Arc;
use std::time::Duration;

use glam::DAffine3;
use nightsplat_core::camera::{Camera, TrainingFrame};
use nightsplat_models::gaussians::{Gaussians, ModelFacts};
use nightsplat_photographs::dataset::{Dataset, Fingerprint};
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::SceneLaw;

use super::batching::CALL;
use super::clock::RunClock;
use super::config::TrainConfig;
use super::context::Initial;
use super::memory::{Memory, MemoryEstimate};
use super::model::TrainedModel;
use super::networks::Networks;
use super::passes::background;
use super::rendered::Rendered;
use super::supervision::Supervision;
use crate::gpu::{CheckReport, Gpu, PassTime, Recorder};
use crate::loss::Term;
use crate::splats::lamp::Lamp;
use crate::splats::optimizer::{AdamStep, GaussianStep, LearningRates};
use crate::splats::render::{
    GradientNorm, Gradients, Instance, Purpose, RenderOptions, RenderSettings,
};
use crate::{Error, Result, splats};
use nightsplat_photographs::exposures::Affine;

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
    pub(super) gpu: Gpu,
    pub(super) config: Arc<TrainConfig>,
    pub(super) scene: TrainedScene,
    pub(super) supervision: Supervision,
    pub(super) model: TrainedModel,
    pub(super) clock: RunClock,
    pub(super) memory: Memory,
}

/// What a training knows of its dataset.
#[derive(Debug)]
pub(super) struct TrainedScene {
    pub(super) fingerprint: Fingerprint,
    /// The frame of all coordinates on the device.
    pub(super) frame: TrainingFrame,
    /// The extent, in units of the frame.
    pub(super) extent: f64,
    /// The curve from the photographs to the model's colours, where it can be stated.
    pub(super) law: Option<SceneLaw>,
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
        self.clock.step
    }

    /// The last step of the run, as far as known: earlier than configured once the run has converged, or
    /// [`Trainer::finish`] was called.
    pub fn last_step(&self) -> u64 {
        self.clock.last_step()
    }

    /// Whether the last step is done.
    pub fn has_ended(&self) -> bool {
        self.clock.has_ended()
    }

    /// Whether the run may end before its last step.
    #[doc(hidden)]
    pub fn may_end_early(&self) -> bool {
        self.clock.may_end_early()
    }

    /// Lets the run end soon: its cooldown begins after the steps done, unless it has begun, and
    /// [`Trainer::last_step`] is its end. A checkpoint records this.
    pub fn finish(&mut self) {
        self.clock.finish();
    }

    /// The step after which the cooldown begins: no density control, decaying learning rates.
    #[doc(hidden)]
    pub fn cooldown_begin(&self) -> u64 {
        self.clock.cooldown_begin()
    }

    /// The learning rates of a step, including the cooldown.
    #[doc(hidden)]
    pub fn learning_rates(&self, step: u64) -> LearningRates {
        self.clock.learning_rates(step, self.scene.extent)
    }

    /// The scores of the held-out views so far: step, PSNR in dB.
    pub fn held_out_scores(&self) -> impl DoubleEndedIterator<Item = (u64, f64)> {
        let scores = self.clock.decisions.scores.iter();
        scores.map(|score| (score.step, score.score as f64 / 1e3))
    }

    /// Estimates the memory of the training from its present memory and its largest view.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn memory_estimate(&mut self) -> Result<MemoryEstimate> {
        self.memory.estimate(&mut self.model, &self.clock, &self.supervision.views)
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
        Ok(self.gaussians_in_frame()?.to_world(&self.scene.frame))
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
        let TrainedScene { frame, law, .. } = &self.scene;
        let facts = ModelFacts { law: *law, ..self.config.facts(frame) };
        splats::model::Model::new(in_frame.to_world(frame), &facts)
    }

    /// The Gaussians in [`Trainer::frame`], bit for bit as trained.
    #[doc(hidden)]
    pub fn gaussians_in_frame(&self) -> Result<Gaussians> {
        self.model.gaussians.download(&self.gpu)
    }

    /// The dataset's fingerprint.
    pub(crate) fn fingerprint(&self) -> &Fingerprint {
        &self.scene.fingerprint
    }

    /// The frame in which the Gaussians are trained.
    #[doc(hidden)]
    pub fn frame(&self) -> &TrainingFrame {
        &self.scene.frame
    }

    /// Reserves memory for this number of intersections of a view.
    #[doc(hidden)]
    pub fn set_intersection_capacity(&mut self, intersections: u32) -> Result<()> {
        self.model.renderer.set_intersection_capacity(intersections)
    }

    /// Trains up to `until`, or for about half a second, and reports every step; waits until the device is done. Steps
    /// to be checked ([`TrainConfig::check`]) run one at a time.
    ///
    /// # Errors
    /// [`Error::Usage`] if the run has ended, [`Error::NotFinite`] if a loss term or gradient is not finite and
    /// [`StopConfig::not_finite`](super::StopConfig::not_finite) says to stop, [`Error::TileLimit`] if a tile has more
    /// splats than the device can process, [`Error::Disagrees`] if a checked step differs from its references and
    /// [`TrainConfig::check`] says to stop, or the device is out of memory or lost.
    pub fn advance(&mut self, until: u64) -> Result<Vec<StepReport>> {
        self.clock.submissions.call.next(None);
        self.advance_call(until)
    }

    fn advance_call(&mut self, until: u64) -> Result<Vec<StepReport>> {
        let _phase = tracing::info_span!("steps").entered();
        let step = self.clock.step;
        if until > step && step < self.config.steps && self.has_ended() {
            return Err(Error::Usage(format!(
                "the run has ended at step {step}, before step {until}: the held-out views have converged, or its end \
                 was requested (`Trainer::has_ended`)"
            )));
        }
        match (step + 1).checked_next_multiple_of(self.config.check.every) {
            Some(checked) if checked > until => self.submit_steps(until),
            Some(checked) if checked > step + 1 => self.submit_steps(checked - 1),
            Some(_) if step < until.min(self.last_step()) => self.agreeing_step(),
            _ => self.submit_steps(until),
        }
    }

    /// [`Trainer::advance`] for about `budget` instead of half a second. Held-out views are scored, and the cost of a
    /// round of density control is measured, in parts: a call that does no more than that reports no step. A call takes
    /// a step or scores a view at the least. The model has the same bits as after [`Trainer::advance`].
    ///
    /// # Errors
    /// Those of [`Trainer::advance`].
    pub fn advance_within(&mut self, until: u64, budget: Duration) -> Result<Vec<StepReport>> {
        self.clock.submissions.call.next(Some(budget));
        self.clock.submissions.batching.budget = budget;
        let reports = self.advance_call(until);
        self.clock.submissions.batching.budget = CALL;
        reports
    }

    /// Whether scores or density control are due before the next step, or before the end
    /// ([`Trainer::advance_within`]).
    pub fn is_due(&self) -> bool {
        self.clock.decisions.are_due()
    }

    /// The Gaussians as they are now, in the dataset's world, to draw without a copy. The next call that trains changes
    /// them, so what draws them is recorded and submitted before it, on the trainer's queue.
    pub fn live(&self) -> Instance<'_> {
        let TrainingFrame { center, scale } = self.scene.frame;
        let pose = DAffine3::from_translation(center.into());
        Instance { pose, scale: 1.0 / scale, ..Instance::new(&self.model.gaussians.values) }
    }

    /// The settings of a renderer that draws [`Trainer::live`].
    pub fn live_settings(&self) -> RenderSettings {
        let none = Gaussians::zeros(0, self.model.gaussians.shape());
        RenderSettings { purpose: Purpose::Show, ..self.model_of(&none).render_settings() }
    }

    /// Trains one step with every pass checked; a difference is an error or a warning, as configured.
    fn agreeing_step(&mut self) -> Result<Vec<StepReport>> {
        let (reports, checks) = self.check_step();
        match checks.agree() {
            Err(difference) if self.config.check.stops => return Err(difference),
            Err(difference) => tracing::warn!("step {}: {difference}", self.clock.step),
            Ok(()) => {}
        }
        reports
    }

    /// Trains one step with every pass checked ([`Gpu::checked`]), density control included. The model has the same
    /// bits as after [`Trainer::advance`]; a step that must be redone with more memory is not reported.
    pub fn check_step(&mut self) -> (Result<Vec<StepReport>>, CheckReport) {
        let next = self.clock.step + 1;
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
        let step = self.clock.step + 1;
        self.allocate_sh_degree()?;
        self.supervision.views.make_resident(&self.config, step..=step)?;
        let times = run(&self.gpu.clone(), self, step)?;
        if self.gpu.read(self.model.renderer.status())?.first() == Some(&0) {
            self.clock.step = step;
        }
        Ok(times)
    }

    /// Records a step: render a view, compare it with its pseudo-GT, backward pass, update.
    pub(super) fn record_step(
        &mut self,
        pass: &mut Recorder<'_>,
        step: u64,
        slot: u32,
    ) -> Result<()> {
        let Self { gpu, config, scene, supervision, model, clock, .. } = self;
        let TrainedModel { gaussians, renderer, optimizer, .. } = model;
        let cooldown_factor = clock.cooldown_factor(step);
        let is_floored = step.is_multiple_of(FLOOR_STEPS) || step == clock.last_step();
        let rates = clock.learning_rates(step, scene.extent);
        let options = RenderOptions {
            sh_degree: clock.sh_degree(step),
            background: background(config, step),
        };
        let norm = GradientNorm {
            adds_pixels: config.density.control.strategy().adds_pixels,
            damping_weight: config.schedule.damping_weight(step),
            damping_depth: scene.extent as f32,
        };
        let view = supervision.views.at_step(config, step);

        renderer.forward(pass, &gaussians.values, supervision.views.viewpoint(view), &options)?;
        supervision.compare(pass, step, view, gaussians.shape().features, renderer, slot)?;
        renderer.backward(
            pass,
            &gaussians.values,
            supervision.views.viewpoint(view),
            &options,
            norm,
            &supervision.d_render,
            Gradients {
                parameters: &mut gaussians.gradients,
                grad_norm_sums: &mut gaussians.grad_norm_sums,
                visit_counts: &mut gaussians.visit_counts,
            },
        )?;
        supervision.regularise(pass, gaussians, renderer, slot)?;
        let status = renderer.status();
        let gaussian_step = GaussianStep {
            adam: AdamStep { step, rates: &rates, status },
            sh_degree: options.sh_degree,
            camera: renderer.camera_of(&supervision.views.viewpoint(view)),
        };
        gaussians.update(gpu, pass, &optimizer.adam, gaussian_step, renderer.gradient_kind())?;
        if let Some(floor) = optimizer.floor.as_ref().filter(|_| is_floored) {
            floor.record(pass, &mut gaussians.values, status)?;
        }
        supervision.update(pass, &optimizer.adam, step, cooldown_factor, status)?;
        match &mut optimizer.lamp {
            Some(lamp) => lamp.update(&optimizer.adam, pass, renderer, step, cooldown_factor),
            None => Ok(()),
        }
    }

    /// The SH degree reached so far.
    pub(super) fn sh_degree_in_use(&self) -> u32 {
        self.clock.sh_degree(self.clock.step).min(self.model.gaussians.shape().sh_degree)
    }

    /// Allocates memory for the SH degree of the next step.
    pub(super) fn allocate_sh_degree(&mut self) -> Result<()> {
        let degree = self.clock.sh_degree(self.clock.step + 1);
        if degree > self.model.gaussians.shape().sh_degree {
            self.model.set_sh_degree(&self.gpu, degree)
        } else {
            Ok(())
        }
    }

    /// The curves of the photographs.
    #[doc(hidden)]
    pub fn scene(&self) -> &SceneTone {
        &self.supervision.targets.scene
    }

    /// The exposure of each training view, by name; `None` if exposures are not learned.
    #[doc(hidden)]
    pub fn exposures(&self) -> Result<Option<Vec<(String, Affine)>>> {
        let Some(exposures) = &self.supervision.exposures else { return Ok(None) };
        let names = self.supervision.views.names().map(str::to_owned);
        Ok(Some(names.zip(exposures.affines()?).collect()))
    }

    /// The lamp as learned so far, in units of the dataset's world; `None` without one.
    #[doc(hidden)]
    pub fn lamp(&self) -> Result<Option<Lamp>> {
        Ok(self.model.renderer.lamp()?.map(|lamp| lamp.scaled(1.0 / self.scene.frame.scale)))
    }

    /// The gradients that the last step wrote, in the frame: with `GradientKind::Colors` zeros above SH degree 0, and
    /// those of the means lack the part through the viewing direction.
    #[doc(hidden)]
    pub fn gradients(&self) -> Result<Gaussians> {
        let kind = self.model.renderer.gradient_kind();
        self.model.gaussians.download_gradients(&self.gpu, kind)
    }

    /// The floats of a plane set of gradients or moments.
    #[doc(hidden)]
    pub fn trained_floats(&self) -> usize {
        self.model.gaussians.gradients.len()
    }

    /// The networks, if the model has any.
    #[doc(hidden)]
    pub fn networks(&mut self) -> Option<&mut Networks> {
        self.supervision.networks()
    }

    /// Renders the model from `camera`, with the SH degree reached so far, over a black background.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn render(&mut self, camera: &Camera) -> Result<Rendered> {
        let camera = self.scene.frame.camera(camera);
        let sh_degree = self.sh_degree_in_use();
        self.model.render(&camera, sh_degree, self.supervision.networks())
    }

    /// [`Trainer::render`] in even light, as [`Trainer::model`] is, if the model has a lamp.
    #[doc(hidden)]
    pub fn render_in_even_light(&mut self, camera: &Camera) -> Result<Rendered> {
        self.model.renderer.set_even_light(true);
        let rendered = self.render(camera);
        self.model.renderer.set_even_light(false);
        rendered
    }
}
