//! Early stopping: a run whose held-out views stop improving cools down, ends, and keeps its best model.
//!
//! ```text growth -> converged, or the last steps begin -> cooldown: no density control, learning rates decay -> end
//! ```
//!
//! Scores fluctuate with the most recent views and with every round of density control. So they are never taken right
//! after a round, and a run that has converged ends only after a cooldown.

use nightsplat_photographs::dataset::{Dataset, Split};
use serde::{Deserialize, Serialize};

use super::best::Snapshot;
use super::decisions::{Decisions, HeldOutScore};
use super::target_views::TargetViews;
use super::{TrainConfig, Trainer};
use crate::Result;
use crate::targets::Targets;

/// Steps after a round of density control in which the held-out views are not scored.
const SETTLING_DISTANCE: u64 = 50;

/// The reason for the end of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum EndReason {
    /// The held-out views have stopped improving.
    Converged,
    /// All steps are done.
    Steps,
}

/// The end of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ended {
    /// The reason.
    pub reason: EndReason,
    /// Its last step.
    pub step: u64,
    /// The step whose model is kept: the last, unless the held-out views scored higher at an earlier one.
    pub best_step: u64,
}

impl std::fmt::Display for Ended {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { reason, step, best_step } = self;
        let why = match reason {
            EndReason::Converged => "the held-out views have converged",
            EndReason::Steps => "all steps are done",
        };
        write!(out, "ended at step {step}: {why}")?;
        if best_step == step {
            Ok(())
        } else {
            write!(out, "; the model of step {best_step} is kept")
        }
    }
}

/// The state of early stopping.
#[derive(Debug)]
pub(super) struct Convergence {
    pub(super) held_out: TargetViews,
    pub(super) decisions: Decisions,
    /// The model with the best score of the held-out views; empty without one.
    pub(super) best: Snapshot,
}

impl Convergence {
    /// The state before the first step, with the targets of the held-out views.
    pub(super) fn new(targets: &Targets, dataset: &Dataset, config: &TrainConfig) -> Result<Self> {
        let frame = config.frame.unwrap_or_default();
        let held_out = dataset.views.iter().filter(|view| view.split == Split::HeldOut);
        let held_out = TargetViews::new(targets, held_out, &frame)?;
        if config.stop.views > 0 && held_out.is_empty() {
            tracing::info!("every held-out view is black or masked: the run takes all its steps");
        }
        Ok(Self { held_out, decisions: Decisions::default(), best: vec![] })
    }
}

impl Trainer {
    /// The last step of the run, as far as known: earlier than configured once the run has converged.
    pub fn last_step(&self) -> u64 {
        let early =
            self.converged().map(|converged| converged + self.config.effective_cooldown_steps());
        early.map_or(self.config.steps, |early| early.min(self.config.steps))
    }

    /// The step at which the run converged, if that ends it.
    fn converged(&self) -> Option<u64> {
        self.convergence.decisions.converged.filter(|_| !self.convergence.decisions.goes_on)
    }

    /// Whether the last step is done.
    pub fn has_ended(&self) -> bool {
        self.step >= self.last_step()
    }

    /// Whether the run may end before its last step.
    #[doc(hidden)]
    pub fn may_end_early(&self) -> bool {
        let is_open = self.converged().is_none() && !self.convergence.decisions.goes_on;
        is_open && self.step < self.cooldown_begin() && !self.convergence.held_out.is_empty()
    }

    /// The step after which the cooldown begins: no density control, decaying learning rates.
    #[doc(hidden)]
    pub fn cooldown_begin(&self) -> u64 {
        let planned = self.config.steps - self.config.effective_cooldown_steps();
        self.converged().map_or(planned, |converged| converged.min(planned))
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

    /// The scores of the held-out views so far: step, PSNR in dB.
    pub fn held_out_scores(&self) -> impl DoubleEndedIterator<Item = (u64, f64)> {
        self.convergence.decisions.scores.iter().map(|score| (score.step, score.score as f64 / 1e3))
    }

    /// Whether the held-out views are scored after this step: at the end, and every
    /// [`TrainConfig::scored_every`] steps but not right after a round of density control.
    pub(super) fn scores_at(&self, step: u64) -> bool {
        if self.convergence.held_out.is_empty() {
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

    /// Scores the held-out views, keeps the model if it is the best so far, and decides whether the run has converged.
    pub(super) fn score_held_out(&mut self) -> Result<()> {
        let _phase = tracing::info_span!("scoring").entered();
        let Some([psnr, detail]) = self.held_out_psnr_and_detail()? else { return Ok(()) };
        let [_, whole] = self.config.schedule.resolution_steps;
        let [score, detail] = [1e3 * psnr, 1e6 * detail].map(|score| score.round() as i64);
        let score = HeldOutScore { step: self.step, score, detail };
        tracing::debug!(
            "step {}: held-out views {psnr:.3} dB, detail {:.5}",
            self.step,
            detail as f64 / 1e6
        );
        let is_best = self.best_score().is_none_or(|best| score.score > best.score);
        if is_best && self.step >= whole {
            self.convergence.best = self.snapshot()?;
        }
        self.convergence.decisions.scores.push(score);
        let scores = self.convergence.decisions.scores.iter().filter(|score| score.step >= whole);
        let scores: Vec<[f64; 2]> =
            scores.map(|score| [score.score as f64 / 1e3, score.detail as f64 / 1e6]).collect();
        if self.may_end_early() && self.config.stop.has_converged(&scores) {
            self.convergence.decisions.converged = Some(self.step);
            tracing::info!(
                "step {}: the held-out views have converged; the run ends at step {}",
                self.step,
                self.last_step()
            );
        }
        Ok(())
    }

    /// The first of the best scores since views have their full size; its model is kept.
    fn best_score(&self) -> Option<HeldOutScore> {
        let [_, whole] = self.config.schedule.resolution_steps;
        let scores = self.convergence.decisions.scores.iter().filter(|score| score.step >= whole);
        scores.copied().reduce(|best, next| if next.score > best.score { next } else { best })
    }

    /// Ends the run with its best model: if the last score is lower than the best by more than
    /// [`StopConfig::margin`](super::StopConfig::margin), the model of the best is restored. No steps may follow; to
    /// continue later, save a checkpoint first.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn end(&mut self) -> Result<Ended> {
        if std::mem::take(&mut self.convergence.decisions.score_due) {
            self.score_held_out()?;
        }
        let step = self.step;
        let reason = self.converged().map_or(EndReason::Steps, |_| EndReason::Converged);
        let last = self.convergence.decisions.scores.last().filter(|last| last.step == step);
        let lost =
            |best: &HeldOutScore| last.map_or(0.0, |last| (best.score - last.score) as f64 / 1e3);
        let better = self.best_score().filter(|best| lost(best) > self.config.stop.margin);
        let best = std::mem::take(&mut self.convergence.best);
        if better.is_some() {
            self.restore_snapshot(&best)?;
        }
        Ok(Ended { reason, step, best_step: better.map_or(step, |better| better.step) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::gpu;
    use crate::train::StopConfig;
    use nightsplat_photographs::dataset::Dataset;
    use nightsplat_synth::SyntheticOptions;

    #[test]
    fn a_run_ends_once_two_scores_in_a_row_gain_too_little() {
        let stop = StopConfig { gain: 0.05, detail_gain: 0.1, ..StopConfig::default() };
        for (scores, ends) in [
            (&[][..], false),
            (&[20.0, 20.0], false),
            (&[20.0, 20.02, 20.04], true),
            (&[20.0, 19.0, 20.06], false),
            (&[20.0, 20.5, 20.5, 20.5], true),
            (&[20.0, 21.0, 20.0, 20.9], true),
            (&[20.0, 20.1, 20.2, 20.3, 20.4], false),
        ] {
            let alone: Vec<_> = scores.iter().map(|score| [*score, 0.5]).collect();
            assert_eq!(stop.has_converged(&alone), ends, "{scores:?}");
            // As long as detail grows the run goes on.
            let grows = scores.iter().zip(1..).map(|(score, step)| [*score, 0.2 * f64::from(step)]);
            assert!(!stop.has_converged(&grows.collect::<Vec<_>>()), "{scores:?}");
        }
    }

    /// A call may return before `step` on a slow machine.
    fn train_until(trainer: &mut Trainer, step: u64) {
        while trainer.step < step {
            trainer.train_steps(step, &mut vec![]).unwrap();
        }
    }

    /// A trainer on a small set with a held-out view, after some steps and a score.
    fn scored(margin: f64) -> Trainer {
        let folder = tempfile::tempdir().unwrap();
        let options = SyntheticOptions {
            views: 10,
            width: 32,
            height: 24,
            seed: 3,
            ..SyntheticOptions::default()
        };
        nightsplat_synth::write(folder.path(), &options).unwrap();
        let mut config = TrainConfig { steps: 20, ..TrainConfig::bare() };
        (config.stop.views, config.stop.margin) = (1, margin);
        config.schedule.resolution_steps = [0, 0];
        let dataset = Dataset::load(folder.path(), &config.load_options()).unwrap();
        let mut trainer = Trainer::new(&gpu(), config, &dataset).unwrap();
        train_until(&mut trainer, 12);
        trainer.score_held_out().unwrap();
        trainer
    }

    #[test]
    fn a_run_that_ends_worse_is_restored_and_one_within_the_margin_is_not() {
        for (margin, best_step) in [(0.25, 12), (90.0, 20)] {
            let mut trainer = scored(margin);
            let best = trainer.gaussians().unwrap();
            train_until(&mut trainer, 20);
            // Damage: no Gaussian is visible.
            let gpu = trainer.gpu.clone();
            let parameters = &mut trainer.model.gaussians.parameters;
            let faint = vec![-20.0; parameters.len()];
            gpu.write(parameters, &faint).unwrap();
            trainer.score_held_out().unwrap();
            let ended = trainer.end().unwrap();
            assert_eq!(ended, Ended { reason: EndReason::Steps, step: 20, best_step });
            assert_eq!(trainer.gaussians().unwrap() == best, best_step == 12);
            assert_eq!(ended.to_string().contains("the model of step 12 is kept"), best_step == 12);
        }
    }

    #[test]
    fn the_best_model_survives_a_killed_process() {
        let mut trainer = scored(0.25);
        let file = tempfile::NamedTempFile::new().unwrap();
        let best = trainer.gaussians().unwrap();
        train_until(&mut trainer, 16);
        trainer.save_checkpoint(file.path()).unwrap();
        let mut restored = scored(0.25);
        restored.convergence.best.clear();
        restored.restore(file.path()).unwrap();
        assert_eq!(
            (restored.step, restored.convergence.best.len()),
            (16, trainer.convergence.best.len())
        );
        let kept = restored.convergence.best.clone();
        restored.restore_snapshot(&kept).unwrap();
        assert!(restored.gaussians().unwrap() == best);
    }
}
