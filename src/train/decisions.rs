//! Decisions of the held-out views: the end of growth, the highest SH degree, and convergence.
//!
//! Each is made at a known step from the model at that step, so a repeated run decides the same; a checkpoint contains
//! the decisions and their data.

use serde::{Deserialize, Serialize};

/// Rounds of density control over which growth must gain enough.
pub(super) const PATIENCE: usize = 4;

/// The state before a round of density control.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct RecordedRound {
    pub(super) step: u64,
    /// The score of the held-out views in thousandths of a dB, an integer to be exact in files.
    pub(super) score: i64,
    pub(super) gaussians: usize,
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
    pub(super) rounds: Vec<RecordedRound>,
    /// The number of Gaussians when growth ended.
    pub(super) gaussians: Option<usize>,
    /// The highest degree that gained enough.
    pub(super) sh_degree: Option<u32>,
    /// Every score of the held-out views so far.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) scores: Vec<HeldOutScore>,
    /// The step at which the run converged; it then cools down and ends.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) converged: Option<u64>,
    /// The step at which the end was requested; the run then cools down and ends.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) finish: Option<u64>,
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
    /// Whether anything is due before the next step.
    pub(super) fn are_due(&self) -> bool {
        self.score_due || self.density_due.is_some() || self.degree_due
    }

    /// Whether growth ends at the last round because it gained less than `growth_gain` dB for each doubling of the
    /// Gaussians.
    pub(super) fn gains_too_little(&self, growth_gain: f64) -> bool {
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
