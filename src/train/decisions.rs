//! Decisions of the held-out views: the end of growth, the highest SH degree, and convergence.
//!
//! Each is made at a known step from the model at that step, so a repeated run decides the same; a checkpoint contains
//! the decisions and their data.

use serde::{Deserialize, Serialize};

use super::Trainer;
use crate::Result;

/// Rounds of density control over which growth must gain enough.
const PATIENCE: usize = 4;

/// The state before a round of density control.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct RecordedRound {
    step: u64,
    /// The score of the held-out views in thousandths of a dB, an integer to be exact in files.
    score: i64,
    gaussians: usize,
}

/// The score of the held-out views after a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct HeldOutScore {
    pub(super) step: u64,
    /// Their mean PSNR in thousandths of a dB.
    pub(super) score: i64,
    /// Their mean detail, SSIM after the least-squares gain and bias of each channel, in millionths.
    pub(super) detail: i64,
}

/// Decisions and their data.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub(super) struct Decisions {
    rounds: Vec<RecordedRound>,
    /// The number of Gaussians when growth ended.
    gaussians: Option<usize>,
    /// The highest degree that gained enough.
    pub(super) sh_degree: Option<u32>,
    /// Every score of the held-out views so far.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) scores: Vec<HeldOutScore>,
    /// The step at which the run converged; it then cools down and ends.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) converged: Option<u64>,
    /// The run was resumed with another number of steps, and trains all of them.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub(super) goes_on: bool,
    /// Scoring of the held-out views is due.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub(super) score_due: bool,
    /// The intersections of the last step, if a round of density control is due.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) density_due: Option<u32>,
    /// A decision on the SH degree is due.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub(super) degree_due: bool,
}

impl Decisions {
    /// Whether growth ends at the last round because it gained less than `growth_gain` dB for each doubling of the
    /// Gaussians.
    fn gains_too_little(&self, growth_gain: f64) -> bool {
        let Some(before) = self.rounds.len().checked_sub(PATIENCE) else { return false };
        let (before, since) = self.rounds.split_at(before);
        let best =
            |rounds: &[RecordedRound]| rounds.iter().max_by_key(|round| round.score).copied();
        let (Some(before), Some(since), Some(last)) = (best(before), best(since), since.last())
        else {
            return false;
        };
        let doublings = (last.gaussians as f64 / before.gaussians.max(1) as f64).log2();
        ((since.score - before.score) as f64) < 1e3 * growth_gain * doublings
    }
}

impl Trainer {
    /// The SH degree of a step.
    pub(super) fn sh_degree(&self, step: u64) -> u32 {
        let highest = self.convergence.decisions.sh_degree.unwrap_or(self.config.sh_degree);
        self.config.sh_degree_at(step, highest)
    }

    /// The SH degree reached so far.
    pub(super) fn sh_degree_in_use(&self) -> u32 {
        self.sh_degree(self.step).min(self.model.shape().sh_degree)
    }

    /// Allocates memory for the SH degree of the next step.
    pub(super) fn allocate_sh_degree(&mut self) -> Result<()> {
        let degree = self.sh_degree(self.step + 1);
        if degree > self.model.shape().sh_degree { self.set_sh_degree(degree) } else { Ok(()) }
    }

    /// Changes the SH degree of model and renderer.
    pub(super) fn set_sh_degree(&mut self, degree: u32) -> Result<()> {
        self.model.set_sh_degree(&self.gpu, degree)?;
        self.renderer.set_sh_degree(degree)
    }

    /// The limit of Gaussians from the held-out views, decided before every round of density control.
    pub(super) fn growth_limit(&mut self) -> Result<usize> {
        let growth_gain = self.config.stop.growth_gain;
        let [_, whole] = self.config.schedule.resolution_steps;
        // A score taken before memory ran out is not taken again.
        let is_scored =
            self.convergence.decisions.rounds.last().is_some_and(|round| round.step == self.step);
        if growth_gain > 0.0 && self.convergence.decisions.gaussians.is_none() && self.step >= whole
        {
            let psnr = if is_scored { None } else { self.held_out_psnr()? };
            if let Some(psnr) = psnr {
                let (step, gaussians) = (self.step, self.model.count());
                self.convergence.decisions.rounds.push(RecordedRound {
                    step,
                    score: (1e3 * psnr).round() as i64,
                    gaussians,
                });
            }
            if self.convergence.decisions.gains_too_little(growth_gain) {
                self.convergence.decisions.gaussians = Some(self.model.count());
                tracing::info!(
                    "step {}: growth ends at {} Gaussians: {PATIENCE} rounds gained less on the held-out views than \
                     {growth_gain} dB for each doubling",
                    self.step,
                    self.model.count()
                );
            }
        }
        Ok(self.convergence.decisions.gaussians.unwrap_or(usize::MAX))
    }

    /// Whether the SH degree in use is evaluated after this step: the next step would raise it, or would if there were
    /// a higher degree.
    pub(super) fn decides_degree_at(&self, step: u64) -> bool {
        let interval = self.config.schedule.sh_degree_interval.max(1);
        self.config.stop.degree_gain > 0.0
            && self.convergence.decisions.sh_degree.is_none()
            && (step + 1).is_multiple_of(interval)
            && step < self.config.steps
            && self.config.schedule.sh_degree(step, self.config.sh_degree) > 0
    }

    /// Compares the held-out views with and without the SH degree in use; a degree that gains too little is removed for
    /// good.
    pub(super) fn decide_degree(&mut self) -> Result<()> {
        let (degree, least) = (self.sh_degree(self.step), self.config.stop.degree_gain);
        let with = self.held_out_psnr_of_degree(degree)?;
        let without = self.held_out_psnr_of_degree(degree - 1)?;
        let Some((with, without)) = with.zip(without) else { return Ok(()) };
        let gain = with - without;
        if gain >= least {
            tracing::info!("step {}: SH degree {degree} gains {gain:.2} dB", self.step);
            return Ok(());
        }
        tracing::info!(
            "step {}: SH degree {degree} gains {gain:.2} dB on the held-out views, less than {least}: it stays at {}",
            self.step,
            degree - 1
        );
        self.set_sh_degree(degree - 1)?;
        self.convergence.decisions.sh_degree = Some(degree - 1);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decisions(rounds: &[(i64, usize)]) -> Decisions {
        let round = |(i, &(score, gaussians)): (usize, &(i64, usize))| RecordedRound {
            step: 100 * i as u64,
            score,
            gaussians,
        };
        Decisions { rounds: rounds.iter().enumerate().map(round).collect(), ..Decisions::default() }
    }

    #[test]
    fn growth_ends_once_four_rounds_gain_too_little_for_what_they_add() {
        let grown = [(20_000, 100), (20_100, 150), (20_150, 200), (20_180, 300), (20_190, 400)];
        // 0.19 dB for two doublings.
        assert!(decisions(&grown).gains_too_little(0.1));
        assert!(!decisions(&grown).gains_too_little(0.09));
        assert!(!decisions(&grown[..4]).gains_too_little(0.1));
        let fallen = [(20_000, 100), (20_900, 120), (19_000, 140), (19_000, 150), (19_500, 160)];
        assert!(!decisions(&fallen).gains_too_little(0.5), "the best round counts");
        let full = [(20_000, 100); 5];
        assert!(!decisions(&full).gains_too_little(0.5), "without growth no gain is needed");
    }
}
