//! Early stopping.

use nightsplat_core::settings;
use nightsplat_core::settings::Rule;
use serde::{Deserialize, Serialize};

settings! {
"stop."
/// Early stopping of a run or of a part of it. Scores are against targets, never against references.
#[derive(Clone, Debug, PartialEq)]
pub struct StopConfig {
    /// Hold out this many training views, an eighth of them at most; 0: none, and no run stops early.
    views: usize = 8 => Rule::COUNT, in "views";
    /// Score them every N steps; with frozen geometry, every 50 at most. A score due within 50 steps after a round of
    /// density control is taken at the end of these.
    every: u64 = 250 => Rule::at_least(1), in "steps";
    /// The run has converged once two scores in a row do not exceed the best before by this much, nor their detail by
    /// `stop.detail_gain`; it then cools down and ends.
    gain: f64 = 0.1 => Rule::POSITIVE_OR_0, in "dB";
    /// Detail is the SSIM of the held-out views after the least-squares gain and bias of each channel: it grows when
    /// PSNR, which follows the brightness of the views, has converged.
    detail_gain: f64 = 0.001 => Rule::POSITIVE_OR_0, in "SSIM";
    /// A run whose last score is below its best by more than this restores the model of its best.
    margin: f64 = 0.25 => Rule::POSITIVE_OR_0, in "dB";
    /// Growth ends once four rounds of density control gain less than this for each doubling of the Gaussians; 0:
    /// never.
    growth_gain: f64 = 0.0 => Rule::POSITIVE_OR_0, in "dB";
    /// A loss or gradient that is not finite: stop ends the run with an error that names step, view and term; skip-view
    /// leaves the view out from then on.
    not_finite: NotFinite = NotFinite::Stop => Rule::OneOf(&["stop", "skip-view"]);
    /// The SH degree returns to the previous one, for good, once the one in use gains less than this; 0: never.
    degree_gain: f64 = 0.0 => Rule::POSITIVE_OR_0, in "dB";
}
}

/// The treatment of a view whose loss or gradient is not finite. The step itself changes nothing in either case.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NotFinite {
    /// End the run with an error that names step, view and term.
    #[default]
    Stop,
    /// Leave the view out from then on.
    SkipView,
}

impl StopConfig {
    /// Whether a run with these scores, PSNR and detail, in order, has converged.
    pub(crate) fn has_converged(&self, scores: &[[f64; 2]]) -> bool {
        const PATIENCE: usize = 2;
        let Some(before) = scores.len().checked_sub(PATIENCE).filter(|&before| before > 0) else {
            return false;
        };
        let (before, since) = scores.split_at(before);
        [self.gain, self.detail_gain].into_iter().enumerate().all(|(metric, gain)| {
            let best = |scores: &[[f64; 2]]| {
                scores.iter().map(|score| score[metric]).fold(f64::NEG_INFINITY, f64::max)
            };
            best(since) < best(before) + gain
        })
    }

    /// The first setting that differs in `other` among those that a resumed run may change, with both values.
    pub(in crate::train) fn change(&self, other: &Self) -> Option<String> {
        let settings = [
            ("every", self.every as f64, other.every as f64),
            ("gain", self.gain, other.gain),
            ("detail_gain", self.detail_gain, other.detail_gain),
            ("margin", self.margin, other.margin),
        ];
        let changed = settings.into_iter().find(|(_, before, now)| before != now);
        changed.map(|(name, before, now)| format!("stop.{name} was {before} and is {now}"))
    }
}
