//! The clock of a run: the steps done, and what is due after a step by the schedule and by the decisions of the
//! held-out views.
//!
//! ```text
//! growth -> converged, or the end is requested, or the last steps begin
//!        -> cooldown: no density control, learning rates decay -> end
//! ```
//!
//! Scores fluctuate with the most recent views and with every round of density control. So they are never taken right
//! after a round, and a run that has converged ends only after a cooldown.

use std::sync::Arc;

use nightsplat_models::gaussians::ATTRIBUTES;

use super::batching::Submissions;
use super::config::TrainConfig;
use super::decisions::{Decisions, HeldOutScore};
use super::early_stopping::EndReason;
use crate::splats::optimizer::LearningRates;

/// Steps after a round of density control in which the held-out views are not scored.
const SETTLING_DISTANCE: u64 = 50;

/// The steps of a run and its decisions; all else is a function of them.
#[derive(Debug)]
pub(super) struct RunClock {
    config: Arc<TrainConfig>,
    /// Steps done.
    pub(super) step: u64,
    pub(super) decisions: Decisions,
    /// Whether there are views to score.
    has_held_out: bool,
    pub(super) submissions: Submissions,
}

impl RunClock {
    /// The clock before the first step.
    pub(super) fn new(config: Arc<TrainConfig>, has_held_out: bool) -> Self {
        let (decisions, submissions) = (Decisions::default(), Submissions::default());
        Self { config, step: 0, decisions, has_held_out, submissions }
    }

    /// The last step of the run, as far as known: earlier than configured once the run has converged, or its end was
    /// requested.
    pub(super) fn last_step(&self) -> u64 {
        let early = self.early_cooldown().map(|from| from + self.config.effective_cooldown_steps());
        early.map_or(self.config.steps, |early| early.min(self.config.steps))
    }

    /// The step at which the run converged, or its end was requested, if that ends it.
    fn early_cooldown(&self) -> Option<u64> {
        let Decisions { converged, finish, goes_on, .. } = &self.decisions;
        converged.filter(|_| !goes_on).or(*finish)
    }

    /// Lets the run cool down from here and end, unless it does already.
    pub(super) fn finish(&mut self) {
        if self.step >= self.cooldown_begin() {
            return;
        }
        self.decisions.finish = Some(self.step);
        let is_scored = self.decisions.scores.last().is_some_and(|last| last.step == self.step);
        self.decisions.score_due = self.has_ended() && self.has_held_out && !is_scored;
    }

    /// What ends the run, as far as known.
    pub(super) fn end_reason(&self) -> EndReason {
        match (self.early_cooldown(), self.decisions.finish) {
            (None, _) => EndReason::Steps,
            (Some(_), None) => EndReason::Converged,
            (Some(_), Some(_)) => EndReason::Requested,
        }
    }

    /// Whether the last step is done.
    pub(super) fn has_ended(&self) -> bool {
        self.step >= self.last_step()
    }

    /// Whether the run may end before its last step.
    pub(super) fn may_end_early(&self) -> bool {
        let is_open = self.early_cooldown().is_none() && !self.decisions.goes_on;
        is_open && self.step < self.cooldown_begin() && self.has_held_out
    }

    /// The step after which the cooldown begins.
    pub(super) fn cooldown_begin(&self) -> u64 {
        let planned = self.config.steps - self.config.effective_cooldown_steps();
        self.early_cooldown().map_or(planned, |from| from.min(planned))
    }

    /// The factor of all learning rates of a step.
    pub(super) fn cooldown_factor(&self, step: u64) -> f64 {
        let (length, since) =
            (self.config.effective_cooldown_steps(), step.saturating_sub(self.cooldown_begin()));
        if length == 0 {
            1.0
        } else {
            self.config.schedule.cooldown_factor(since as f64 / length as f64)
        }
    }

    /// The learning rates of a step in a scene of this extent, including the cooldown.
    pub(super) fn learning_rates(&self, step: u64, extent: f64) -> LearningRates {
        let rates = self.config.schedule.learning_rates(step, extent);
        let mut rates = rates.scaled(self.cooldown_factor(step));
        for spec in &ATTRIBUTES {
            if self.config.freezes(spec.attribute) {
                rates[spec.attribute] = 0.0;
            }
        }
        rates
    }

    /// The SH degree of a step.
    pub(super) fn sh_degree(&self, step: u64) -> u32 {
        let highest = self.decisions.sh_degree.unwrap_or(self.config.sh_degree);
        self.config.sh_degree_at(step, highest)
    }

    /// Whether density control acts after this step: not in the cooldown, nor within the last interval of the run.
    pub(super) fn densifies_at(&self, step: u64) -> bool {
        let schedule = &self.config.schedule;
        let is_in_time = step + schedule.densify_interval <= self.config.steps;
        schedule.densifies_at(step)
            && is_in_time
            && step <= self.cooldown_begin()
            && !self.config.freezes_geometry()
    }

    /// Whether the SH degree in use is evaluated after this step: the next step would raise it, or would if there were
    /// a higher degree.
    pub(super) fn decides_degree_at(&self, step: u64) -> bool {
        let interval = self.config.schedule.sh_degree_interval.max(1);
        self.config.stop.degree_gain > 0.0
            && self.decisions.sh_degree.is_none()
            && (step + 1).is_multiple_of(interval)
            && step < self.config.steps
            && self.config.schedule.sh_degree(step, self.config.sh_degree) > 0
    }

    /// Whether the held-out views are scored after this step: at the end, and every
    /// [`TrainConfig::scored_every`] steps but not right after a round of density control.
    pub(super) fn scores_at(&self, step: u64) -> bool {
        if !self.has_held_out {
            return false;
        }
        let due = step - step % self.config.scored_every();
        let is_first = due > 0 && (due..step).all(|earlier| self.is_unsettled(earlier));
        step == self.last_step() || is_first && !self.is_unsettled(step)
    }

    /// Whether a round of density control was so recent that it would affect a score.
    fn is_unsettled(&self, step: u64) -> bool {
        let interval = self.config.schedule.densify_interval.max(1);
        let round = (step - 1) / interval * interval;
        step > 1 && self.densifies_at(round) && step - round < SETTLING_DISTANCE.min(interval)
    }

    /// Whether something is due after this step that steps must not run past: density control may change the number of
    /// Gaussians, and a higher SH degree their memory.
    pub(super) fn pauses_at(&self, step: u64) -> bool {
        self.densifies_at(step)
            || self.sh_degree(step + 1) > self.sh_degree(step)
            || self.decides_degree_at(step)
            || self.scores_at(step)
    }

    /// Scores since views have their full size.
    pub(super) fn whole_scores(&self) -> impl Iterator<Item = HeldOutScore> {
        let [_, whole] = self.config.resolution_steps();
        self.decisions.scores.iter().filter(move |score| score.step >= whole).copied()
    }

    /// The first of the best scores since views have their full size; its model is kept.
    pub(super) fn best_score(&self) -> Option<HeldOutScore> {
        self.whole_scores().reduce(|best, next| if next.score > best.score { next } else { best })
    }
}
