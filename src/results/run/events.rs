//! What a run tells its observer.

use super::meter::ResourceUsage;
use crate::results::eval::ViewScore;
use crate::train::{Ended, MemoryEstimate, StepReport, Trainer};

/// A moment of a run, in the order in which they come.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub enum Event<'a> {
    /// The model is on the device.
    Started {
        /// Steps that a resumed run has behind it; otherwise 0.
        step: u64,
        /// The step that ends the run.
        steps: u64,
        /// The run may end before it, once the held-out views have converged.
        may_end_early: bool,
        /// What it is going to take.
        memory: &'a MemoryEstimate,
    },
    /// A step is done and in the log. Steps are submitted several at a time and arrive so.
    Step(&'a StepReport),
    /// What the run can go on from is on disk.
    Checkpointed {
        /// Steps done.
        step: u64,
    },
    /// The held-out views were scored against their targets.
    HeldOut {
        /// Steps done.
        step: u64,
        /// Their mean PSNR, dB.
        psnr: f64,
    },
    /// The run no longer ends early, or it has converged: what its last step is, is certain.
    LastStep {
        /// Steps done.
        step: u64,
        /// The last step.
        last: u64,
    },
    /// The last step is done, and the model of the best step is in place.
    Ended(&'a Ended),
    /// The test views were scored, on the way or behind the last step.
    Evaluated {
        /// Steps done.
        step: u64,
        /// The views that have a reference image.
        scored: &'a [ViewScore],
    },
    /// The run directory is whole.
    Finished(&'a RunSummary),
}

/// What a run made.
#[derive(Debug)]
pub struct RunSummary {
    /// The model and its networks, on the device.
    pub trainer: Trainer,
    /// How it ended.
    pub ended: Ended,
    /// The test views that have a reference image.
    pub scored: Vec<ViewScore>,
    /// The loss of every step of this call.
    pub losses: Vec<f64>,
    /// What the steps took, without loading and scoring; the seconds before a resumed run included.
    pub spent: ResourceUsage,
}
