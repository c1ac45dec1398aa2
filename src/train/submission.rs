//! Submissions of steps: while the device runs one, the next is recorded.
//!
//! A submission is long enough to hide its overhead and short enough for the watchdog of a slow device. Batching
//! changes no bit: a step that cannot be done raises a flag on the device, and later steps change nothing until the
//! host has handled it.

use std::collections::VecDeque;
use std::ops::RangeInclusive;
use std::time::{Duration, Instant};

use nightsplat_core::watch::Stage;

use super::batching::StepBatching;
use super::config::NotFinite;
use super::model::TrainedModel;
use super::supervision::Supervision;
use super::trainer::{StepReport, Trainer};
use super::views::TrainView;
use crate::gpu::Download;
use crate::loss::{LossLogDownload, StepLosses};
use crate::splats::render::Status;
use crate::{Error, Result};

/// The interval of checks for NaN, which read a hundredth of what Adam reads.
const FINITE_STEPS: u64 = 50;

/// Submitted steps.
struct Submitted {
    steps: RangeInclusive<u64>,
    at: Instant,
    log: LossLogDownload,
    status: Download<u32>,
}

impl Trainer {
    /// Fixes the number of submissions in flight, and the steps of each; `None`: chosen by timing.
    #[doc(hidden)]
    pub fn set_batching(&mut self, in_flight: usize, steps: Option<u64>) {
        self.clock.submissions.batching = StepBatching::fixed(in_flight, steps);
    }

    /// Fixes the time of a step from which on its passes are submitted one by one.
    #[doc(hidden)]
    pub fn set_slow_step(&mut self, slow_step: Duration) {
        self.clock.submissions.batching.slow_step = slow_step;
    }

    /// Trains up to `until`, up to the next step of density control, or for about half a second.
    ///
    /// If that fails after finished steps, these are reported first and the next call returns the error, so that
    /// reports match the model.
    pub(super) fn submit_steps(&mut self, until: u64) -> Result<Vec<StepReport>> {
        if let Some(error) = self.clock.submissions.failed.take() {
            return Err(error);
        }
        let mut reports = vec![];
        match self.train_interval(until, &mut reports) {
            Err(error) if !reports.is_empty() => self.clock.submissions.failed = Some(error),
            done => done?,
        }
        // Steps before a non-finite parameter are not reported.
        if self.clock.step >= self.model.optimizer.checked + FINITE_STEPS {
            self.check_finite()?;
        }
        Ok(reports)
    }

    fn train_interval(&mut self, until: u64, reports: &mut Vec<StepReport>) -> Result<()> {
        // A run resumed after running out of memory starts with what was due.
        self.control()?;
        if self.clock.decisions.are_due() {
            return Ok(());
        }
        self.train_steps(until, reports)?;
        self.clock.submissions.call.has_worked = true;
        self.control()
    }

    /// Trains up to `until`, up to the next step with an action due, or for about half a second.
    pub(super) fn train_steps(&mut self, until: u64, reports: &mut Vec<StepReport>) -> Result<()> {
        self.allocate_sh_degree()?;
        let (views, call) = (&mut self.supervision.views, &self.clock.submissions.call);
        self.model.keep_lists(&self.gpu, &self.config, views, call)?;
        let (begin, mut next) = (self.clock.submissions.call.begin, self.clock.step + 1);
        let stage = Stage::begin("training", self.config.steps as usize);
        let until = until.min(self.last_step());
        let last = (next..until).find(|&step| self.clock.pauses_at(step)).unwrap_or(until);
        let (mut in_flight, mut sent) = (VecDeque::new(), Ok(()));
        loop {
            while sent.is_ok()
                && next <= last
                && in_flight.len() < self.clock.submissions.batching.in_flight
            {
                let has_news = !(reports.is_empty() && in_flight.is_empty());
                let batching = &self.clock.submissions.batching;
                // What is in flight and what would be sent are to end within the budget.
                let ahead = batching.step * (in_flight.len() as u32 + 1) * batching.steps() as u32;
                if has_news && begin.elapsed() + ahead > batching.budget {
                    break;
                }
                let steps = next..=last.min(next + self.clock.submissions.batching.steps() - 1);
                // If one cannot be submitted, those before it still change the model.
                let goes_on = stage.at(*steps.start() as usize - 1);
                sent = goes_on.and_then(|()| self.load_and_submit(steps)).map(|submitted| {
                    next = submitted.steps.end() + 1;
                    in_flight.push_back(submitted);
                });
            }
            let Some(oldest) = in_flight.pop_front() else { break };
            // Steps in flight after a failed one change nothing.
            if !self.complete(oldest, reports)? {
                break;
            }
        }
        self.clock.decisions.score_due =
            !reports.is_empty() && self.clock.scores_at(self.clock.step);
        self.clock.decisions.degree_due =
            !reports.is_empty() && self.clock.decides_degree_at(self.clock.step);
        if !reports.is_empty() && self.clock.densifies_at(self.clock.step) {
            // The round is due whether or not there is memory for it.
            self.clock.decisions.density_due = Some(0);
            self.clock.decisions.density_due = Some(self.model.renderer.intersections()?);
        }
        sent
    }

    /// Performs the actions due after the last step, as far as the call has time. An action that fails leaves the model
    /// unchanged and stays due.
    pub(super) fn control(&mut self) -> Result<()> {
        match self.act() {
            Err(Error::Halted { .. }) if self.clock.submissions.call.is_over => Ok(()),
            done => done,
        }
    }

    fn act(&mut self) -> Result<()> {
        if self.clock.decisions.score_due {
            self.score_held_out()?;
            self.clock.decisions.score_due = false;
            // A run that has converged does not grow.
            let (step, decisions) = (self.clock.step, &mut self.clock.decisions);
            decisions.density_due.take_if(|_| decisions.converged == Some(step));
        }
        if let Some(intersections) = self.clock.decisions.density_due {
            self.control_density(intersections)?;
        }
        if self.clock.decisions.degree_due {
            self.decide_degree()?;
            self.clock.decisions.degree_due = false;
        }
        self.clock.submissions.call.settle();
        Ok(())
    }

    fn load_and_submit(&mut self, steps: RangeInclusive<u64>) -> Result<Submitted> {
        let first = *steps.start();
        let fitting = self.supervision.views.make_resident(&self.config, steps)?;
        self.submit(first..=fitting)
    }

    /// Checks every parameter of the Gaussians on the device.
    fn check_finite(&mut self) -> Result<()> {
        self.model.optimizer.checked = self.clock.step;
        match self.model.first_not_finite(&self.gpu)? {
            Some(at) => Err(self.not_finite("gaussians.parameters", at)),
            None => Ok(()),
        }
    }

    fn submit(&mut self, steps: RangeInclusive<u64>) -> Result<Submitted> {
        let gpu = self.gpu.clone();
        let (first, mut downloads) = (*steps.start(), None);
        gpu.submit("steps", |pass| {
            if self.clock.submissions.batching.is_slow() {
                pass.cut_between_passes();
            }
            self.supervision.log.clear(pass);
            for step in steps.clone() {
                self.record_step(pass, step, (step - first) as u32)?;
            }
            downloads = Some((
                self.supervision.log.download(pass)?,
                pass.download(self.model.renderer.status())?,
            ));
            Ok(())
        })?;
        let Some((log, status)) = downloads else {
            return Err(Error::Usage(
                "steps that were not recorded cannot be waited for".to_owned(),
            ));
        };
        Ok(Submitted { steps, at: Instant::now(), log, status })
    }

    /// Waits for a submission and reports its steps; false if one must be redone.
    fn complete(&mut self, submitted: Submitted, reports: &mut Vec<StepReport>) -> Result<bool> {
        let Submitted { steps, at, log, status } = submitted;
        let (log, status) = (log.wait()?, Status::from_words(&status.wait()?));
        let count = steps.end() - steps.start() + 1;
        self.clock.submissions.batching.measure(at, count);
        // Steps from the first failed one on have changed nothing.
        let done = log.iter().take(count as usize).take_while(|losses| losses.status == 0).count();
        // This flag is raised after the loss: by the step before the first one that saw it.
        let done = if status.gradient_not_finite { done.saturating_sub(1) } else { done };
        let milliseconds = self.clock.submissions.batching.step.as_secs_f64() * 1e3 * count as f64
            / done.max(1) as f64;
        let losses = steps.zip(&log[..done]);
        reports.extend(losses.map(|(step, losses)| self.report(step, losses, milliseconds)));
        self.clock.step += done as u64;
        if done == count as usize {
            return Ok(true);
        }
        self.answer(status, &log[done])?;
        Ok(false)
    }

    /// Handles a raised flag before the step is redone.
    fn answer(&mut self, status: Status, losses: &StepLosses) -> Result<()> {
        let step = self.clock.step + 1;
        let view = || self.view_of(step).name.clone();
        if status.overflowed {
            self.model.renderer.grow(status.intersections)?;
            let renderer = &mut self.model.renderer;
            return self.gpu.clone().run("clear_status", |pass| {
                renderer.clear_status(pass);
                Ok(())
            });
        }
        if status.splats_per_tile > 0 {
            let view = format!("step {step}, view {}", view());
            return Err(self.model.renderer.too_many_splats(view, status.splats_per_tile));
        }
        let what = match losses.first_not_finite() {
            Some(term) => term.name,
            None if status.gradient_not_finite => "a gradient",
            None => "the loss",
        };
        let error = Error::NotFinite { step, view: view(), what: what.to_owned() };
        if self.config.stop.not_finite == NotFinite::Stop || !self.leave_out_view_of(step)? {
            return Err(error);
        }
        tracing::warn!("{error}; the step changed nothing; the run continues without the view");
        Ok(())
    }

    /// Leaves out the view of an undone step; false if it is the last view.
    fn leave_out_view_of(&mut self, step: u64) -> Result<bool> {
        let photograph = self.view_of(step).photograph;
        if !self.supervision.views.leave_out(photograph) {
            return Ok(false);
        }
        let TrainedModel { gaussians, renderer, .. } = &mut self.model;
        self.gpu.run("clear_status", |pass| {
            renderer.clear_status(pass);
            // Some Gaussians may have added to the statistics before the flag was raised.
            pass.fill(&mut gaussians.grad_norm_sums, 0);
            pass.fill(&mut gaussians.visit_counts, 0);
            Ok(())
        })?;
        Ok(true)
    }

    /// The view of a step.
    pub(super) fn view_of(&self, step: u64) -> &TrainView {
        let Supervision { views, .. } = &self.supervision;
        views.get(views.at_step(&self.config, step))
    }

    fn report(&self, step: u64, losses: &StepLosses, milliseconds: f64) -> StepReport {
        let config = self.config.loss();
        let value = |term| (term, f64::from(losses.get(term)));
        StepReport {
            step,
            view: self.view_of(step).name.clone(),
            loss: config.total(losses),
            terms: config.terms().into_iter().map(value).collect(),
            gaussians: self.model.count(),
            milliseconds,
        }
    }
}
