//! Events of a run, for its observer.

use super::meter::ResourceUsage;
use crate::results::eval::Evaluation;
use crate::splats::model::Model;
use crate::train::{Ended, MemoryEstimate, StepReport, Trainer};

/// An event of a run, in order of occurrence.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub enum Event<'a> {
    /// The model is on the device.
    Started {
        /// Steps before a resumed run, else 0.
        step: u64,
        /// The last step.
        steps: u64,
        /// Whether the run may end earlier, once the held-out views have converged.
        may_end_early: bool,
        /// The memory estimate.
        memory: &'a MemoryEstimate,
    },
    /// A step is done and logged. Steps are submitted and reported in batches.
    Step(&'a StepReport),
    /// A checkpoint is on disk.
    Checkpointed {
        /// Steps done.
        step: u64,
    },
    /// The model as it is, on request.
    Snapshot {
        /// Steps done.
        step: u64,
        /// The model, in the dataset's world.
        model: &'a Model,
        /// The time that the training waited for it.
        seconds: f64,
    },
    /// The held-out views were scored against their targets.
    HeldOut {
        /// Steps done.
        step: u64,
        /// Their mean PSNR, dB.
        psnr: f64,
    },
    /// The last step is certain: the held-out views have converged, the end was requested, or the run can no longer end
    /// early.
    LastStep {
        /// Steps done.
        step: u64,
        /// The last step.
        last: u64,
    },
    /// The last step is done, and the model of the best step is restored.
    Ended(&'a Ended),
    /// The test views were scored, during the run or after its last step.
    Evaluated {
        /// Steps done.
        step: u64,
        /// The scores of the views that have a reference image.
        evaluation: &'a Evaluation,
    },
    /// The run directory is complete.
    Finished(&'a RunSummary),
}

/// The result of a run.
#[derive(Debug)]
pub struct RunSummary {
    /// The model and its networks, on the device.
    pub trainer: Trainer,
    /// How it ended.
    pub ended: Ended,
    /// The scores of the test views that have a reference image.
    pub evaluation: Evaluation,
    /// The loss of every step of this call.
    pub losses: Vec<f64>,
    /// Resources of the steps, without loading and scoring, including the seconds before a resumed run.
    pub spent: ResourceUsage,
}
