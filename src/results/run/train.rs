//! Trains into a run directory and reports events.

mod events;

use std::path::Path;
use std::time::{Duration, Instant};

use nightsplat_photographs::dataset::{Dataset, View};
use nightsplat_report::tensorboard::EventFile;

use super::directory::RunProgress;
use super::files::{ENDED, HELD_OUT_CURVE, SPENT, TARGET_EXPOSURE, TRAINED_WITH, trained_with};
use super::meter::{ResourceMeter, ResourceUsage};
use super::{Event, Requests, RunDirectory, RunSummary, done, generations, load};
use crate::gpu::Gpu;
use crate::results::eval::{self, Evaluation, Extras, ScoreReference, ScoredImages};
use crate::train::plan::Plan;
use crate::train::{Ended, MemoryEstimate, Settings, TrainConfig, Trainer};
use crate::{Error, Result, Stop};

/// What to do with an existing run in the directory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum IfExists {
    /// Keep it and train nothing.
    #[default]
    Refuse,
    /// Delete it.
    Replace,
    /// Resume it from its checkpoint, with the same bits as an uninterrupted run; start again if there is no
    /// checkpoint.
    Resume,
}

/// Options of a run.
#[derive(Clone, Debug, Default)]
pub struct Session<'a> {
    /// The plan that the configuration and dataset already follow; it is saved in the run directory.
    pub plan: Option<&'a Plan>,
    /// The origins of the configuration's values, for config.toml.
    pub settings: Option<&'a Settings>,
    /// What to do with an existing run.
    pub if_exists: IfExists,
    /// Requests while it trains.
    pub requests: Requests,
}

/// Trains `config` on `dataset`, scores the test views and writes the run directory `out`.
///
/// `observe` is called with every [`Event`] on the calling thread. `dataset` must be loaded with
/// [`TrainConfig::load_options`].
///
/// # Errors
/// The directory contains a run that `if_exists` keeps, or cannot be written; the configuration is invalid or not that
/// of the run to resume; a loss is not finite; the device is out of memory or lost.
///
/// ```no_run
/// use std::path::Path;
///
/// use nightsplat::run::{self, Event, IfExists};
/// use nightsplat::{Dataset, DeviceChoice, Gpu, TrainConfig};
///
/// let config = TrainConfig { dataset: "photos".into(), steps: 2000, ..TrainConfig::default() };
/// let gpu = Gpu::new(&DeviceChoice::Best)?;
/// let dataset = Dataset::load(&config.dataset, &config.load_options())?;
/// let trained = run::train(&gpu, &config, &dataset, Path::new("run"), IfExists::Refuse, |event| {
///     if let Event::Step(report) = event {
///         println!("step {}: loss {:.4}", report.step, report.loss);
///     }
/// })?;
/// println!("{} Gaussians in {:.0} s", trained.trainer.gaussian_count(), trained.spent.seconds);
/// # Ok::<(), nightsplat::Error>(())
/// ```
pub fn train(
    gpu: &Gpu,
    config: &TrainConfig,
    dataset: &Dataset,
    out: &Path,
    if_exists: IfExists,
    observe: impl FnMut(Event<'_>),
) -> Result<RunSummary> {
    train_in(gpu, config, dataset, out, &Session { if_exists, ..Session::default() }, observe)
}

/// [`train`] with the options of a [`Session`].
pub fn train_in(
    gpu: &Gpu,
    config: &TrainConfig,
    dataset: &Dataset,
    out: &Path,
    session: &Session<'_>,
    mut observe: impl FnMut(Event<'_>),
) -> Result<RunSummary> {
    gpu.reset_peak_memory();
    let stamp = Dataset::stamp(&dataset.root, &config.load_options()).ok();
    let (mut directory, mut trainer) = begin(gpu, config, dataset, out, session)?;
    if let Some(plan) = session.plan {
        directory.save_plan(plan)?;
    }
    directory.save_views(dataset)?;
    let memory = trainer.memory_estimate()?;
    warn_of_memory(gpu, &memory);
    observe(Event::Started {
        step: trainer.steps_done(),
        steps: trainer.last_step(),
        may_end_early: trainer.may_end_early(),
        memory: &memory,
    });
    let mut train_loop = TrainLoop::new(gpu, config, dataset, &directory, &trainer);
    let requests = &session.requests;
    let losses = train_loop.train_to_end(&mut trainer, &mut directory, requests, &mut observe);
    let losses = losses
        .inspect_err(|error| train_loop.save_on_error(error, &mut trainer, &mut directory))?;
    let finished = train_loop.finish(&mut trainer, &mut directory, &mut observe);
    let (ended, evaluation, spent) = finished
        .inspect_err(|error| train_loop.save_on_error(error, &mut trainer, &mut directory))?;
    let (gaussians, steps) = (trainer.gaussian_count(), trainer.steps_done());
    let mut metrics = evaluation.json(Some(spent.seconds), Some(gaussians), Some(steps));
    metrics[SPENT] = serde_json::json!(spent);
    eval::add_reference(&mut metrics, &config.tone);
    let tone = trainer.scene();
    if let (Some(model_gain), Some(scene)) = (tone.model_gain, tone.model_exposure()) {
        let gains = tone.gains(dataset);
        metrics[TARGET_EXPOSURE] =
            serde_json::json!({ "model_gain": model_gain, "scene": scene, "gains": gains });
    }
    evaluation.add_other_steps(&mut metrics, config.exposure.learn);
    metrics[ENDED] = serde_json::json!(ended);
    metrics[TRAINED_WITH] = trained_with(gpu);
    if let Some(curve) = held_out_curve(&trainer) {
        metrics[HELD_OUT_CURVE] = curve;
    }
    directory.save_metrics(&metrics)?;
    done::save(out, config, trainer.fingerprint(), stamp, &ended, gpu)?;
    let trained = RunSummary { trainer, ended, evaluation, losses, spent };
    observe(Event::Finished(&trained));
    Ok(trained)
}

/// Warns if the driver has less free memory than the run may need.
fn warn_of_memory(gpu: &Gpu, memory: &MemoryEstimate) {
    let Some(budget) = gpu.memory_budget() else { return };
    let left = budget.budget.saturating_sub(budget.usage) + gpu.memory_in_use();
    if memory.peak_device > left {
        let mebibytes = |bytes: u64| bytes >> 20;
        tracing::warn!(
            "{} Gaussians may take {} MiB of the device, {} MiB are free: max_vram or max_gaussians stops growth \
             in time",
            memory.peak_gaussians,
            mebibytes(memory.peak_device),
            mebibytes(left)
        );
    }
}

/// Begins a new run, or resumes one.
fn begin(
    gpu: &Gpu,
    config: &TrainConfig,
    dataset: &Dataset,
    out: &Path,
    session: &Session<'_>,
) -> Result<(RunDirectory, Trainer)> {
    let if_exists = session.if_exists;
    // A tile size that the device does not support is refused before a directory is created.
    config.render_settings().tile_on(gpu)?;
    match if_exists {
        IfExists::Refuse => RunDirectory::check(out, false)?,
        IfExists::Replace => RunDirectory::check(out, true)?,
        IfExists::Resume => RunDirectory::check_resumed(out)?,
    }
    let lock = RunDirectory::lock(out)?;
    let resumes = if_exists == IfExists::Resume;
    let checkpoint = if resumes { generations::newest(out) } else { None };
    let mut config = with_what_is_found(gpu, config, dataset, checkpoint.is_some().then_some(out))?;
    // The disk of the run has space for the photographs, too.
    config.spool.get_or_insert_with(|| out.to_owned());
    let config = &config;
    let explain = |directory: &RunDirectory| match session.settings {
        Some(settings) => directory.save_config(config, settings, gpu),
        None => Ok(()),
    };
    let mut trainer = match checkpoint {
        Some(_) => Trainer::to_restore(gpu, config.clone(), dataset)?,
        None => Trainer::new(gpu, config.clone(), dataset)?,
    };
    if let Some(checkpoint) = checkpoint {
        trainer.restore(&checkpoint)?;
        let step = trainer.steps_done();
        tracing::info!("{} goes on after step {step}", out.display());
        let mut directory = RunDirectory::resume(out, lock, config, step)?;
        // Restores the model of the checkpoint, as later steps are lost.
        directory.save_trained(&mut trainer)?;
        explain(&directory)?;
        return Ok((directory, trainer));
    }
    // Without a checkpoint, nothing of an unfinished run is lost.
    let replaces = match if_exists {
        IfExists::Refuse => false,
        IfExists::Replace => true,
        IfExists::Resume => !load::is_finished(out),
    };
    let directory = RunDirectory::create_locked(out, lock, config, replaces)?;
    explain(&directory)?;
    Ok((directory, trainer))
}

/// The configuration with the tile size, training frame and up direction to record: with these, the bits do not depend
/// on later measurements. Each is from the configuration, else from the `resumed` run, else the fastest known on the
/// device or the dataset's. A run without a recorded frame was trained in the dataset's world.
fn with_what_is_found(
    gpu: &Gpu,
    config: &TrainConfig,
    dataset: &Dataset,
    resumed: Option<&Path>,
) -> Result<TrainConfig> {
    let mut config = config.clone();
    if let Some(run) = resumed {
        let recorded = load::load_config(run)?;
        let tile = recorded.tile.filter(|&tile| gpu.properties().suits_tile(tile));
        config.tile = config.tile.or(tile);
        config.frame = Some(recorded.frame.unwrap_or_default());
        config.up = config.up.or(recorded.up);
    }
    let patches = dataset.views.iter().flat_map(|view| config.patches(gpu, &view.camera));
    let sizes: Vec<[u32; 2]> = patches.map(|patch| patch.size.to_array()).collect();
    config.tile = Some(config.render_settings().tile_for(gpu, sizes.into_iter())?);
    config.frame.get_or_insert_with(|| dataset.frame());
    config.up.get_or_insert_with(|| dataset.up().to_array());
    Ok(config)
}

/// The progress of a run and its resources.
struct TrainLoop<'a> {
    gpu: &'a Gpu,
    config: &'a TrainConfig,
    dataset: &'a Dataset,
    meter: ResourceMeter,
    /// Steps before this call.
    begin: u64,
    /// Steps in a checkpoint.
    saved: u64,
    progress: Vec<RunProgress>,
    /// Created at the first scoring.
    score_reference: Option<ScoreReference>,
    /// For `TensorBoard`; created at the first event.
    events: Option<EventFile>,
    /// Number of reported scores of the held-out views.
    told: usize,
    /// The reported last step, and whether the run may end earlier.
    end: (u64, bool),
}

impl<'a> TrainLoop<'a> {
    fn new(
        gpu: &'a Gpu,
        config: &'a TrainConfig,
        dataset: &'a Dataset,
        directory: &RunDirectory,
        trainer: &Trainer,
    ) -> Self {
        let (meter, begin) = (ResourceMeter::new(directory.seconds_before()), trainer.steps_done());
        let progress = directory.progress(begin);
        Self {
            gpu,
            config,
            dataset,
            meter,
            begin,
            saved: begin,
            progress,
            score_reference: None,
            events: None,
            told: trainer.held_out_scores().count(),
            end: (trainer.last_step(), trainer.may_end_early()),
        }
    }

    /// Logs every step, writes checkpoints, and ends early if configured; returns the losses.
    fn train_to_end(
        &mut self,
        trainer: &mut Trainer,
        directory: &mut RunDirectory,
        requests: &Requests,
        observe: &mut impl FnMut(Event<'_>),
    ) -> Result<Vec<f64>> {
        let (config, mut losses) = (self.config, vec![]);
        let (begin, mut saved) = (Instant::now(), Instant::now());
        let is_over = |since: Instant, minutes: f64| {
            minutes > 0.0 && since.elapsed() >= Duration::from_secs_f64(60.0 * minutes)
        };
        while !trainer.has_ended() {
            self.attend(trainer, directory, requests, observe)?;
            if requests.takes_finish() {
                self.finish_early(trainer, directory, observe)?;
                continue;
            }
            let next = |every| (trainer.steps_done() + 1).checked_next_multiple_of(every);
            let until = [config.eval_every, config.checkpoint_every, config.hash_every];
            let until = until.into_iter().filter_map(next).min().unwrap_or(config.steps);
            let reports = self.meter.measure(|| trainer.advance(until))?;
            for report in &reports {
                losses.push(report.loss);
                directory.log(report)?;
                observe(Event::Step(report));
            }
            directory.flush_log()?;
            if !reports.is_empty() {
                directory.settle()?;
            }
            if config.tensorboard {
                self.write_events(trainer, directory, &reports)?;
            }
            self.log_scores(trainer, directory, observe)?;
            let Some(step) = reports.last().map(|report| report.step) else { continue };
            let falls_on = |every: u64| every > 0 && step.is_multiple_of(every);
            if falls_on(config.hash_every) {
                directory.log_hashes(step, &trainer.gaussians_in_frame()?)?;
            }
            let stop =
                requests.stops().or(is_over(begin, config.max_minutes).then_some(Stop::TimeUp));
            let stop = stop.filter(|_| !trainer.has_ended());
            let is_last = trainer.has_ended() && config.checkpoint_every > 0;
            let saves = requests.takes_save() || is_over(saved, config.checkpoint_minutes);
            if falls_on(config.checkpoint_every) || is_last || saves || stop.is_some() {
                directory.save_checkpoint(trainer)?;
                (self.saved, saved) = (step, Instant::now());
                observe(Event::Checkpointed { step });
            }
            if let Some(cause) = stop {
                return Err(Error::Stopped { run: directory.path().to_owned(), step, cause });
            }
            if falls_on(config.eval_every) && !trainer.has_ended() {
                self.evaluate(trainer, directory, observe)?;
            }
        }
        Ok(losses)
    }

    /// Hands out the model if it is requested, and waits as long as a pause is.
    fn attend(
        &mut self,
        trainer: &mut Trainer,
        directory: &mut RunDirectory,
        requests: &Requests,
        observe: &mut impl FnMut(Event<'_>),
    ) -> Result<()> {
        const LOOKS_AGAIN: Duration = Duration::from_millis(50);
        loop {
            let (step, begin) = (trainer.steps_done(), Instant::now());
            if requests.takes_snapshot() {
                let model = &trainer.model()?;
                let seconds = begin.elapsed().as_secs_f64();
                observe(Event::Snapshot { step, model, seconds });
            }
            if !requests.is_paused() || requests.stops().is_some() || requests.finishes() {
                return Ok(());
            }
            if requests.takes_save() {
                directory.save_checkpoint(trainer)?;
                self.saved = step;
                observe(Event::Checkpointed { step });
            }
            std::thread::sleep(LOOKS_AGAIN);
        }
    }

    /// Begins the cooldown, as requested. A checkpoint records the request, unless no step is done.
    fn finish_early(
        &mut self,
        trainer: &mut Trainer,
        directory: &mut RunDirectory,
        observe: &mut impl FnMut(Event<'_>),
    ) -> Result<()> {
        trainer.finish();
        let step = trainer.steps_done();
        if step > 0 {
            directory.save_checkpoint(trainer)?;
            self.saved = step;
            observe(Event::Checkpointed { step });
        }
        self.log_scores(trainer, directory, observe)
    }

    /// Restores the best model if the last is worse, scores the test views and writes the model.
    fn finish(
        &mut self,
        trainer: &mut Trainer,
        directory: &mut RunDirectory,
        observe: &mut impl FnMut(Event<'_>),
    ) -> Result<(Ended, Evaluation, ResourceUsage)> {
        let _phase = tracing::info_span!("scoring").entered();
        let ended = trainer.end()?;
        if let Some(events) = &mut self.events {
            events.text(ended.step, "run/ended", &ended.to_string())?;
        }
        observe(Event::Ended(&ended));
        trainer.drop_unused_denoiser()?;
        let spent = self.meter.spent(self.gpu.peak_memory());
        let evaluation = self.evaluate(trainer, directory, observe)?;
        let render = |view: &View| trainer.render(&view.camera);
        eval::warn_of_holes(&evaluation, self.dataset, self.config.background, render)?;
        directory.save_trained(trainer)?;
        Ok((ended, evaluation, spent))
    }

    /// Saves the state before an error that does not damage it, such as a lack of memory or a missing file.
    fn save_on_error(&self, error: &Error, trainer: &mut Trainer, directory: &mut RunDirectory) {
        let is_lost = matches!(
            error,
            Error::Stopped { .. }
                | Error::DeviceLost { .. }
                | Error::NotFinite { .. }
                | Error::ParameterNotFinite { .. }
                | Error::Disagrees { .. }
        );
        let step = trainer.steps_done();
        if is_lost || step <= self.saved {
            return;
        }
        match directory.save_checkpoint(trainer) {
            Ok(()) => tracing::warn!("the run ends early; its {step} steps are saved"),
            Err(error) => {
                tracing::warn!("the run ends early, and its last steps are lost: {error}");
            }
        }
    }

    /// Scores the test views; its time is not that of the run.
    fn evaluate(
        &mut self,
        trainer: &mut Trainer,
        directory: &RunDirectory,
        observe: &mut impl FnMut(Event<'_>),
    ) -> Result<Evaluation> {
        let _phase = tracing::info_span!("scoring").entered();
        let mut score_reference = match self.score_reference.take() {
            Some(reference) => reference,
            None => ScoreReference::in_scene(self.gpu, self.dataset, trainer.scene())?,
        };
        let (step, mut is_first) = (trainer.steps_done(), true);
        let is_even = score_reference.is_evenly_lit(self.dataset);
        let render = |view: &View| match is_even {
            true => trainer.render_in_even_light(&view.camera),
            false => trainer.render(&view.camera),
        };
        let with_gain_and_bias = self.config.exposure.learn;
        let extras = Extras { with_gain_and_bias, ..Extras::default() };
        let dataset = self.dataset;
        let write_first = |images: &ScoredImages<'_>| match std::mem::take(&mut is_first) {
            true => self.write_event_images(step, images),
            false => Ok(()),
        };
        let mut evaluation =
            Evaluation::new(&mut score_reference, dataset, &extras, render, write_first)?;
        self.score_reference = Some(score_reference);
        evaluation.shows_sky = eval::shows_sky(self.config, || trainer.scene().has_black_sky());
        if self.config.model.lamp {
            evaluation.add_lit(dataset, |view| trainer.render(&view.camera))?;
        }
        observe(Event::Evaluated { step, evaluation: &evaluation });
        self.write_event_scores(step, &evaluation)?;
        if self.config.eval_every > 0 {
            let (gaussians, spent) = (trainer.gaussian_count(), self.meter.spent(0));
            if let Some(progress) = RunProgress::new(step, gaussians, &evaluation, &spent) {
                // An extended run begins at a step that was scored before.
                self.progress.retain(|earlier| earlier.step < step);
                self.progress.push(progress);
                directory.save_progress(&self.progress)?;
            }
        }
        Ok(evaluation)
    }
}

/// The convergence of the held-out views for `metrics.json`: the last score, and the range of the last ten.
fn held_out_curve(trainer: &Trainer) -> Option<serde_json::Value> {
    const LAST: usize = 10;
    let scores: Vec<f64> =
        trainer.held_out_scores().rev().take(LAST).map(|(_, psnr)| psnr).collect();
    let (lowest, highest) =
        (scores.iter().copied().reduce(f64::min)?, scores.iter().copied().reduce(f64::max)?);
    Some(serde_json::json!({
        "psnr": scores.first(),
        "scores": scores.len(),
        "spread": highest - lowest,
    }))
}
