//! The number of steps of a submission, from the time of the last one.

use std::time::{Duration, Instant};

use super::call::Call;
use crate::Error;

/// The most steps of a submission.
pub(super) const MAX_STEPS: u64 = 64;
/// The target time of a submission.
const SUBMISSION: Duration = Duration::from_millis(50);
/// The time of a call that trains.
pub(super) const CALL: Duration = Duration::from_millis(500);
/// The most submissions in flight: one runs, one waits.
const IN_FLIGHT: usize = 2;
/// The passes of slower steps are submitted one by one: Windows resets a device after two seconds of one submission.
const SLOW_STEP: Duration = Duration::from_millis(500);

/// The number of steps per submission, from the time of the last one.
#[derive(Debug)]
pub(super) struct StepBatching {
    pub(super) in_flight: usize,
    /// A fixed number of steps, for tests.
    steps: Option<u64>,
    pub(super) step: Duration,
    /// The time of a call, after which nothing more is submitted.
    pub(super) budget: Duration,
    /// The time of a step from which on its passes are submitted one by one.
    pub(super) slow_step: Duration,
    last_done: Instant,
}

impl Default for StepBatching {
    fn default() -> Self {
        Self {
            in_flight: IN_FLIGHT,
            steps: None,
            step: SUBMISSION,
            budget: CALL,
            slow_step: SLOW_STEP,
            last_done: Instant::now(),
        }
    }
}

impl StepBatching {
    /// A fixed number of submissions in flight, and of steps of each; `None`: by timing.
    pub(super) fn fixed(in_flight: usize, steps: Option<u64>) -> Self {
        Self { in_flight: in_flight.max(1), steps, ..Self::default() }
    }

    /// The steps of the next submission: a quarter of the budget at most, as two of them may be in flight.
    pub(super) fn steps(&self) -> u64 {
        let target = SUBMISSION.min(self.budget / 4);
        let fitting = target.as_secs_f64() / self.step.as_secs_f64().max(1e-6);
        self.steps.unwrap_or(fitting as u64).clamp(1, MAX_STEPS)
    }

    pub(super) fn is_slow(&self) -> bool {
        self.step >= self.slow_step
    }

    /// Measures a finished submission, from when the device was free for it.
    pub(super) fn measure(&mut self, submitted: Instant, steps: u64) {
        let done = Instant::now();
        let took = done.duration_since(submitted.max(self.last_done));
        (self.step, self.last_done) = (took / steps.max(1) as u32, done);
    }
}

/// The state of submissions.
#[derive(Debug, Default)]
pub(super) struct Submissions {
    pub(super) batching: StepBatching,
    pub(super) call: Call,
    /// The error that ended the last call after finished steps.
    pub(super) failed: Option<Error>,
}
