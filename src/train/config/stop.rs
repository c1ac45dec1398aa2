//! When a run ends before its last step.

use serde::{Deserialize, Serialize};

use super::TrainConfig;
use crate::base::settings::{Rule, settings};

settings! {
"stop."
/// When a run, or a part of it, ends before its last step. Scores are against targets, never against references.
#[derive(Clone, Debug, PartialEq)]
pub struct StopConfig {
    /// The number of training views that are held out, an eighth of them at most; 0: none, and no run ends early.
    views: usize = 8 => Rule::COUNT, in "views";
    /// The steps from one score of theirs to the next. A score that falls within 50 steps after a round of density control is
    /// taken at the end of these.
    every: u64 = 250 => Rule::at_least(1), in "steps";
    /// Once two scores in a row do not exceed the best before by this much, the run has converged: it settles and ends.
    gain: f64 = 0.05 => Rule::POSITIVE_OR_0, in "dB";
    /// A run that ends worse than its best score by more than this keeps the model of that score.
    margin: f64 = 0.25 => Rule::POSITIVE_OR_0, in "dB";
    /// Growth ends once four rounds of density control gain less than this for each doubling of the Gaussians; 0: it goes on
    /// to its last step.
    growth_gain: f64 = 0.0 => Rule::POSITIVE_OR_0, in "dB";
    /// What is done about a view whose loss or gradient is not finite: stop ends the run with an error that names step, view
    /// and term, skip-view trains on that view no more.
    not_finite: NotFinite = NotFinite::Stop => Rule::OneOf(&["stop", "skip-view"]);
    /// The SH degree rises no further, and falls back, once the one in use gains less than this; 0: it always rises.
    degree_gain: f64 = 0.0 => Rule::POSITIVE_OR_0, in "dB";
}
}

/// What is done about a view whose loss or gradient is NaN or infinite. The step that finds it changes nothing, either way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NotFinite {
    /// The run ends with an error that names step, view and term.
    #[default]
    Stop,
    /// The view is trained on no more.
    SkipView,
}

impl StopConfig {
    /// Whether a run with these scores, in order, has converged.
    pub(crate) fn has_converged(&self, scores: &[f64]) -> bool {
        const PATIENCE: usize = 2;
        let Some(before) = scores.len().checked_sub(PATIENCE).filter(|&before| before > 0) else {
            return false;
        };
        let best = |of: &[f64]| of.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        best(&scores[before..]) < best(&scores[..before]) + self.gain
    }

    /// The first of the settings that a resumed run may change in which `other` differs, with both values.
    pub(in crate::train) fn change(&self, other: &Self) -> Option<String> {
        let settings = [
            ("every", self.every as f64, other.every as f64),
            ("gain", self.gain, other.gain),
            ("margin", self.margin, other.margin),
        ];
        let changed = settings.into_iter().find(|(_, before, now)| before != now);
        changed.map(|(name, before, now)| format!("stop.{name} was {before} and is {now}"))
    }
}

impl TrainConfig {
    /// The length of the settling phase: that of the schedule, or a third of a run that is short for it.
    pub(crate) fn effective_cooldown_steps(&self) -> u64 {
        self.schedule.cooldown_steps.min(self.steps / 3)
    }
}
