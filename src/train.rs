//! Training: one view a step, its pseudo-GT the target, the Gaussians what is learned.

mod best;
mod cache;
mod checkpoint;
mod config;
mod decisions;
pub mod diagnose;
mod difference;
mod early_stopping;
mod epochs;
mod exposures;
mod fill;
mod growth;
mod layers;
mod masks;
mod measuring;
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
mod target_views;
mod terms;
mod views;

use std::panic::resume_unwind;
use std::thread::{self, ScopedJoinHandle};

use crate::camera::{Camera, Frame};
#[cfg(feature = "check")]
use crate::gpu::CheckReport;
use crate::gpu::{Buffer, Gpu, PassTime, Recorder};
use crate::loss::exposure::Exposures;
use crate::loss::{LogSlot, LossLog, Losses, ParameterTerms, Term, TermInputs};
use crate::photographs::dataset::{Dataset, Fingerprint, Original, Split};
use crate::photographs::pseudo_gt::PseudoGt;
use crate::photographs::tone::Scene;
use crate::splats::densify::{Densifier, DensityControl};
use crate::splats::optimizer::{Adam, FiniteCheck, LearningRates};
use crate::splats::render::{Damping, Gradients, RenderOptions, Renderer};
use crate::splats::scene::{COLOR_CHANNELS, Gaussians};
use crate::{Error, Result};

use best::Snapshot;
pub use cache::CacheSize;
pub use checkpoint::check_checkpoint;
pub use config::{
    Background, CheckConfig, DensityConfig, ExposureConfig, Learning, NotFinite, StopConfig,
    TrainConfig,
};
use decisions::Decisions;
pub use early_stopping::{EndReason, Ended};
pub use layers::{Layer, Origin, Settings, values};
use masks::Masks;
pub use measuring::TargetExposure;
pub use memory::MemoryEstimate;
use model::Model;
pub use networks::Networks;
pub use parts::{ModelConfig, ModelName, NetworkRates, Part};
use passes::{Kernels, background, first_sh_degree, learnables};
pub use planned::{Planned, Planning, Said, diagnosed};
pub use precision::{PhotographBits, PrecisionConfig};
pub use preset::Preset;
pub use reference::reference;
pub use rendered::Rendered;
use submission::{MOST_STEPS, Pace};
use target_views::TargetViews;
pub use target_views::TestTargets;
use terms::{NetworkTerms, Photographs};
use views::Views;

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

/// Training views that tell what a round of density control costs,
const PROBES: usize = 8;
/// and the pixels of one: all take 100 MB of the host at the most.
const MOST_PROBE_PIXELS: usize = 1 << 20;

/// What one step did.
#[derive(Clone, Debug)]
pub struct StepReport {
    /// Counted from 1.
    pub step: u64,
    /// The view it trained on.
    pub view: String,
    /// The weighted sum of the terms.
    pub loss: f64,
    /// Every term that the model has, unweighted.
    pub terms: Vec<(Term, f64)>,
    /// The number of Gaussians it rendered.
    pub gaussians: usize,
    /// Its share of the time its submission took, in milliseconds.
    pub milliseconds: f64,
}

impl StepReport {
    /// The value of a term; 0 where the model does not have it.
    pub fn term(&self, term: Term) -> f64 {
        self.terms.iter().find(|(own, _)| *own == term).map_or(0.0, |&(_, value)| value)
    }
}

/// A model in training, and all that its steps need; [`crate::results::run::train`] drives one into a run directory.
///
/// ```no_run
/// use nightsplat::photographs::dataset::Dataset;
/// use nightsplat::gpu::{DeviceChoice, Gpu};
/// use nightsplat::train::{TrainConfig, Trainer};
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
/// nightsplat::splats::scene::ply::save(&trainer.gaussians()?, "model.ply")?;
/// # Ok::<(), nightsplat::Error>(())
/// ```
#[derive(Debug)]
pub struct Trainer {
    gpu: Gpu,
    config: TrainConfig,
    /// What is trained on.
    fingerprint: Fingerprint,
    /// Where everything on the device lies.
    frame: Frame,
    /// In units of the frame.
    extent: f64,
    /// What the curves of the photographs have in common.
    scene: Scene,
    target_exposure: Option<TargetExposure>,
    held_out: TargetViews,
    /// Training views that tell what a round of density control costs; none where nothing is done about it.
    probes: TargetViews,
    decisions: Decisions,
    /// The model with the best score of the held-out views; empty where there is none.
    best: Snapshot,
    /// Steps done.
    step: u64,
    views: Views,
    model: Model,
    renderer: Renderer,
    losses: Losses,
    masks: Masks,
    networks: Option<NetworkTerms>,
    exposures: Option<Exposures>,
    adam: Adam,
    finite: FiniteCheck,
    /// After this step the parameters were looked at last.
    checked: u64,
    densifier: Densifier,
    /// That there is no room to grow was said.
    has_said_room: bool,
    /// What ended the last stretch behind steps that were done.
    failed: Option<Error>,
    /// On the device, beside what follows the number of Gaussians and intersections, in bytes.
    fixed_bytes: f64,
    /// What makes the target of a step's view,
    pseudo_gt: PseudoGt,
    /// the target, (3, H, W),
    target: Buffer<f32>,
    /// and the dark photograph, where a network sees it.
    photograph: Buffer<f32>,
    parameter_terms: Option<ParameterTerms>,
    d_render: Buffer<f32>,
    log: LossLog,
    pace: Pace,
}

impl Trainer {
    /// Uploads the training views, takes their statistics and places the first Gaussians, or those of [`TrainConfig::init`].
    ///
    /// # Errors
    /// The configuration makes no sense, the model to begin with does not suit it, or the device is out of memory or lost.
    pub fn new(gpu: &Gpu, config: TrainConfig, dataset: &Dataset) -> Result<Self> {
        let initial = config.initial_model()?;
        Self::on_patches(gpu, config, dataset, initial.as_ref())
    }

    /// The same from Gaussians that there are already.
    ///
    /// # Errors
    /// As [`Trainer::new`], or the Gaussians are not made of what the configuration's model is.
    pub fn from_gaussians(
        gpu: &Gpu,
        config: TrainConfig,
        dataset: &Dataset,
        gaussians: &Gaussians,
    ) -> Result<Self> {
        Self::on_patches(gpu, config, dataset, Some(gaussians))
    }

    /// Begins anew on smaller patches where the first Gaussians show that the device could not follow them on these.
    fn on_patches(
        gpu: &Gpu,
        mut config: TrainConfig,
        dataset: &Dataset,
        gaussians: Option<&Gaussians>,
    ) -> Result<Self> {
        loop {
            let mut trainer = Self::begin(gpu, config.clone(), dataset, gaussians)?;
            config.patch_pixels = match trainer.fewer_patch_pixels()? {
                None => {
                    trainer.views.say_what_is_cut(gpu);
                    break Ok(trainer);
                }
                fewer => fewer,
            };
            drop(trainer);
            gpu.free_unused();
        }
    }

    fn begin(
        gpu: &Gpu,
        mut config: TrainConfig,
        dataset: &Dataset,
        gaussians: Option<&Gaussians>,
    ) -> Result<Self> {
        config.check()?;
        config.leave_out_what_is_missing(dataset);
        config.frame.get_or_insert_with(|| dataset.frame());
        thread::scope(|scope| {
            // The driver compiles on another thread while the views are uploaded and looked at.
            let own = config.clone();
            let beside = scope
                .spawn(move || Ok((Kernels::new(gpu, &own, dataset)?, Fingerprint::of(dataset)?)));
            Self::assemble(gpu, config, dataset, gaussians, beside)
        })
    }

    fn assemble(
        gpu: &Gpu,
        config: TrainConfig,
        dataset: &Dataset,
        gaussians: Option<&Gaussians>,
        beside: ScopedJoinHandle<'_, Result<(Kernels, Fingerprint)>>,
    ) -> Result<Self> {
        if let Some(CacheSize(bytes)) = config.max_vram {
            gpu.limit_memory(bytes);
        }
        let settings = config.render_settings();
        let pseudo_gt = PseudoGt::new(gpu, &config.tone)?;
        let frame = config.frame.unwrap_or_default();
        let (views, scene, target_exposure) =
            Views::upload(gpu, &pseudo_gt, dataset, &frame, &config)?;
        let held_out = dataset.views.iter().filter(|view| view.split == Split::HeldOut);
        let held_out = TargetViews::new(&pseudo_gt, held_out, &frame, &scene)?;
        if config.stop.views > 0 && held_out.is_empty() {
            tracing::info!("no held-out view shows anything: the run takes all its steps");
        }
        // No larger than what steps render.
        let largest = views.sizes().iter().map(|size| size.element_product() as usize).max();
        let pixels = largest.unwrap_or_default().min(MOST_PROBE_PIXELS);
        let probes = match config.density.control {
            DensityControl::Conserving => {
                TargetViews::probes(&pseudo_gt, dataset, &frame, &scene, [PROBES, pixels])?
            }
            DensityControl::Paper => TargetViews::default(),
        };
        if let Some(TargetExposure { scene, .. }) = &target_exposure {
            tracing::info!("{}", scene.reason());
        }
        let sizes = views.sizes();
        config.model.say_what_parts_see(&sizes);
        let starts = views.exposures(&pseudo_gt, dataset, &scene, &config)?;
        let gaussians = match gaussians {
            // A run that ended before its highest SH degree was in use has a model without it.
            Some(gaussians) if settings.shape.holds(gaussians.shape) => {
                gaussians.with_sh_degree(settings.shape.sh_degree).from_world(&frame)
            }
            Some(Gaussians { shape: own, .. }) => {
                let problem = format!("Gaussians of {own:?} make no model of {:?}", settings.shape);
                return Err(Error::Usage(problem));
            }
            None => {
                views.initial_gaussians(gpu, &pseudo_gt, dataset, &config, starts.as_deref())?
            }
        };
        views.say_what_shows_nothing(&gaussians);
        let pixels = sizes.iter().map(|size| size.x as usize * size.y as usize).max();
        let values = settings.channels() * pixels.unwrap_or_default();
        let masks = Masks::new(gpu, dataset, &views)?;
        let exposures = starts.map(|starts| Exposures::new(gpu, config.exposure.rates, &starts));
        let mut exposures = exposures.transpose()?;
        if let Some(exposures) = &mut exposures {
            sizes.iter().try_for_each(|&size| exposures.reserve(size))?;
        }
        dataset.views.iter().filter_map(|view| view.original.as_ref()).for_each(Original::release);
        let (Kernels { renderer, mut losses, adam, finite, densifier }, fingerprint) =
            beside.join().unwrap_or_else(|panic| resume_unwind(panic))?;
        losses.prepare(&views.sources(gpu, &pseudo_gt, dataset))?;
        let networks = NetworkTerms::new(gpu, &config, &sizes, !masks.is_empty())?;
        let pictures = views.most_values();
        // Beside the target only networks look at the photograph.
        let photographs = if networks.is_some() { pictures } else { 0 };
        let mut trainer = Self {
            gpu: gpu.clone(),
            fingerprint,
            frame,
            extent: dataset.extent() * frame.scale,
            scene,
            target_exposure,
            held_out,
            probes,
            decisions: Decisions::default(),
            best: vec![],
            step: 0,
            views,
            model: Model::upload(gpu, &gaussians, first_sh_degree(&config), &config.precision)?,
            renderer,
            losses,
            networks,
            pseudo_gt,
            parameter_terms: ParameterTerms::new(gpu, config.loss)?,
            masks,
            exposures,
            adam,
            finite,
            checked: 0,
            densifier,
            has_said_room: false,
            failed: None,
            fixed_bytes: 0.0,
            target: gpu.uninit("target", pictures)?,
            photograph: gpu.uninit("low", photographs)?,
            d_render: gpu.uninit("d_render", values)?,
            log: LossLog::new(gpu, MOST_STEPS as usize)?,
            pace: Pace::default(),
            config,
        };
        // Gaussians that are given may have what the first step does not use.
        trainer.renderer.set_sh_degree(trainer.model.shape().sh_degree)?;
        trainer.reserve()?;
        trainer.keep_activations(&sizes)?;
        trainer.fixed_bytes = trainer.measure_fixed_bytes();
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

    /// The Gaussians as they are now, on the host, in the dataset's world as far as f32 holds it, with the SH degree that the
    /// steps have reached.
    ///
    /// # Errors
    /// The device was lost.
    pub fn gaussians(&self) -> Result<Gaussians> {
        Ok(self.gaussians_in_frame()?.to_world(&self.frame))
    }

    /// The same in [`Trainer::frame`], to the bit as they are trained.
    ///
    /// # Errors
    /// The device was lost.
    pub fn gaussians_in_frame(&self) -> Result<Gaussians> {
        self.model.download(&self.gpu)
    }

    /// What is trained on.
    pub fn fingerprint(&self) -> &Fingerprint {
        &self.fingerprint
    }

    /// Where the Gaussians are trained.
    pub fn frame(&self) -> &Frame {
        &self.frame
    }

    /// Sets how many intersections a view may have before memory has to grow, where that is known better than guessed.
    ///
    /// # Errors
    /// The device is out of memory.
    pub fn set_intersection_capacity(&mut self, intersections: u32) -> Result<()> {
        self.renderer.set_intersection_capacity(intersections)
    }

    /// Trains up to `until`, or for about half a second, and reports every step done; nothing is under way afterwards.
    /// Steps that the configuration wants checked are, each on its own.
    ///
    /// # Errors
    /// [`Error::Usage`] where the run has ended early, [`Error::NotFinite`] where a loss term or a gradient is NaN and [`StopConfig::not_finite`] leaves no view out,
    /// [`Error::Crowded`] where the device cannot follow as many splats as lie on one tile, [`Error::Disagrees`] where a
    /// checked step is to stop at a difference and has one, or the device is out of memory or lost.
    pub fn advance(&mut self, until: u64) -> Result<Vec<StepReport>> {
        if until > self.step && self.step < self.config.steps && self.has_ended() {
            return Err(Error::Usage(format!(
                "the run has ended at step {}, before step {until}, as the held-out views have converged; `Trainer::has_ended` tells",
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

    /// One step with every pass checked; a difference ends the run or is a warning, as the configuration says.
    #[cfg(feature = "check")]
    fn agreeing_step(&mut self) -> Result<Vec<StepReport>> {
        let (reports, checks) = self.check_step();
        match checks.agree() {
            Err(difference) if self.config.check.stops => return Err(difference),
            Err(difference) => tracing::warn!("step {}: {difference}", self.step),
            Ok(()) => {}
        }
        reports
    }

    #[cfg(not(feature = "check"))]
    fn agreeing_step(&mut self) -> Result<Vec<StepReport>> {
        let problem = "`check.every` compares steps with the references, which this build lacks";
        Err(Error::Usage(format!("{problem}: build with feature `check`, or set it to 0")))
    }

    /// Trains one step with every pass checked ([`Gpu::checked`]), density control included, and reports on them. The
    /// model is what [`Trainer::advance`] would have made of it, bit for bit; no step is reported where it has to be done
    /// again with more memory.
    #[cfg(feature = "check")]
    pub fn check_step(&mut self) -> (Result<Vec<StepReport>>, CheckReport) {
        let next = self.step + 1;
        self.gpu.clone().checked(|| self.submit_steps(next))
    }

    /// Trains one step and reports how long each of its passes took on the device.
    ///
    /// # Errors
    /// As [`Trainer::advance`]; a step that overflows its memory is not counted, the next [`Trainer::advance`] redoes it.
    pub fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        let step = self.step + 1;
        self.make_room_for_degree()?;
        self.views.bring(&self.config, step..=step)?;
        let times = self.gpu.clone().profile("step", |pass| self.record_step(pass, step, 0))?;
        if self.gpu.read(self.renderer.status())?.first() == Some(&0) {
            self.step = step;
        }
        Ok(times)
    }

    /// The algorithm: render a view, compare it with its pseudo-GT, go back, update.
    fn record_step(&mut self, pass: &mut Recorder<'_>, step: u64, slot: u32) -> Result<()> {
        let schedule = &self.config.schedule;
        let view = self.views.of_step(self.config.seed, step, schedule.resolution_level(step));
        let settling_rate = self.settling_rate(step);
        let options = RenderOptions {
            sh_degree: self.sh_degree(step),
            background: background(&self.config, step),
        };
        let damping = Damping { weight: schedule.damping_weight(step), depth: self.extent as f32 };
        let model = &mut self.model;

        let viewpoint = self.views.viewpoint(view);
        self.renderer.forward(pass, &model.gaussians, viewpoint, &options)?;
        let (render, status) = self.renderer.render_and_status();
        let (d_render, size) = (&mut self.d_render, view.size());
        let target = self.views.record_target(pass, &self.pseudo_gt, view, &mut self.target)?;
        let log = &mut LogSlot { log: &mut self.log, slot, status };
        let channels = COLOR_CHANNELS + model.shape().features.width();
        let masks = &mut self.masks;
        let inputs = &TermInputs {
            step,
            view: view.number,
            size,
            features: model.shape().features,
            render,
            colors: render,
            target,
        };
        match &mut self.exposures {
            Some(exposures) => {
                exposures.expose(pass, view.place, size, render)?;
                let exposed = exposures.exposed();
                let colors = masks.shown(pass, view.number, size, exposed, target)?;
                let inputs = &TermInputs { colors, ..*inputs };
                self.losses.record(pass, inputs, d_render, log)?;
                masks.hide(pass, view.number, (size, channels), d_render)?;
                exposures.backward(pass, view.place, size, render, d_render)?;
            }
            None => {
                let colors = masks.shown(pass, view.number, size, render, target)?;
                self.losses.record(pass, &TermInputs { colors, ..*inputs }, d_render, log)?;
                masks.hide(pass, view.number, (size, channels), d_render)?;
            }
        }
        if let Some(networks) = &mut self.networks {
            let (pseudo_gt, scratch) = (&self.pseudo_gt, &mut self.photograph);
            let low = self.views.record_photograph(pass, pseudo_gt, view, scratch)?;
            // Networks see the model at the neutral exposure.
            let target = match &mut self.exposures {
                Some(exposures) if networks.follow_target() => {
                    exposures.neutralize(pass, view.place, size, target)?;
                    exposures.exposed()
                }
                _ => target,
            };
            let photographs = Photographs { mask: masks.of_view(view.number), low, target };
            networks.record(pass, inputs, photographs, d_render, log)?;
            masks.hide(pass, view.number, (size, channels), d_render)?;
        }
        self.renderer.backward(
            pass,
            &model.gaussians,
            viewpoint,
            &options,
            damping,
            &self.d_render,
            Gradients {
                parameters: &mut model.gradients,
                grad_norm_sums: &mut model.grad_norm_sums,
                visit_counts: &mut model.visit_counts,
            },
        )?;
        if let Some(terms) = &mut self.parameter_terms {
            let (_, status) = self.renderer.render_and_status();
            let log = &mut LogSlot { log: &mut self.log, slot, status };
            model.record_terms((&self.gpu, pass), terms, log)?;
        }
        let rates = schedule.learning_rates(step, self.extent).scaled(settling_rate);
        let (degree, status) = (options.sh_degree, self.renderer.status());
        model.update((&self.gpu, pass), &self.adam, step, &rates, degree, status)?;
        learnables(&mut self.networks, &mut self.exposures).try_for_each(|learnable| {
            self.adam.update(pass, step, settling_rate, learnable, self.renderer.status())
        })?;
        match &mut self.exposures {
            Some(exposures) => exposures.center(pass, self.renderer.status()),
            None => Ok(()),
        }
    }

    /// The networks; none where the model has none.
    pub fn networks(&mut self) -> Option<&mut Networks> {
        self.networks.as_mut().map(|terms| &mut terms.networks)
    }

    /// The learning rates of a step, before the settling phase or in it.
    pub fn learning_rates(&self, step: u64) -> LearningRates {
        let rates = self.config.schedule.learning_rates(step, self.extent);
        rates.scaled(self.settling_rate(step))
    }

    /// Renders what `camera` sees, with every SH degree trained so far, before a black background.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn render(&mut self, camera: &Camera) -> Result<Rendered> {
        let camera = self.frame.camera(camera);
        self.render_of_degree(&camera, self.sh_degree_in_use())
    }

    /// As [`Trainer::render`], of a camera in the frame.
    fn render_of_degree(&mut self, camera: &Camera, sh_degree: u32) -> Result<Rendered> {
        let options = RenderOptions { sh_degree, background: [0.0; 3] };
        let gaussians = &self.model.gaussians;
        let networks = self.networks.as_mut().map(|terms| &mut terms.networks);
        Rendered::new(&mut self.renderer, gaussians, camera, &options, networks)
    }
}
