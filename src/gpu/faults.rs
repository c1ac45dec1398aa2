//! Injected faults: the n-th allocation finds no memory, or the device is lost from the n-th submission on.
//!
//! Tests inject them into a [`Gpu`](super::Gpu), or into a process by the variable `NIGHTSPLAT_FAULT` (`allocation:17`,
//! `submission:5`, counted from 1).

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use super::lock;
use crate::{Error, Result};

const VARIABLE: &str = "NIGHTSPLAT_FAULT";

/// Counts so far, and the count that fails; 0: none.
#[derive(Debug, Default)]
pub(super) struct Faults {
    allocations: AtomicU64,
    failing_allocation: AtomicU64,
    /// The names of the allocated buffers, where a test records them.
    names: Mutex<Option<Vec<String>>>,
    submissions: AtomicU64,
    losing_submission: AtomicU64,
    is_lost: AtomicBool,
}

impl Faults {
    /// # Errors
    /// [`Error::Usage`] where the variable names another fault.
    pub(super) fn from_environment() -> Result<Self> {
        let faults = Self::default();
        let Ok(text) = std::env::var(VARIABLE) else { return Ok(faults) };
        let number = |text: &str| text.parse::<u64>().ok().filter(|&number| number > 0);
        match text.split_once(':').map(|(what, number_of)| (what, number(number_of))) {
            Some(("allocation", Some(number))) => {
                faults.failing_allocation.store(number, Ordering::Relaxed);
            }
            Some(("submission", Some(number))) => faults.lose_at_submission(number),
            _ => {
                let problem =
                    format!("{VARIABLE}={text}; it is for tests: allocation:N or submission:N");
                return Err(Error::Usage(problem));
            }
        }
        Ok(faults)
    }

    /// Fails the allocation with this number, counted from now on.
    pub(super) fn fail_allocation(&self, number: u64) {
        *lock(&self.names) = Some(vec![]);
        self.allocations.store(0, Ordering::Relaxed);
        self.failing_allocation.store(number, Ordering::Relaxed);
    }

    /// Loses the device at the submission with this number, counted from now on.
    pub(super) fn lose_at_submission(&self, number: u64) {
        self.submissions.store(0, Ordering::Relaxed);
        self.losing_submission.store(number, Ordering::Relaxed);
    }

    /// The buffers that were allocated since a failure was set.
    pub(super) fn allocations(&self) -> Vec<String> {
        lock(&self.names).take().unwrap_or_default()
    }

    /// Counts an allocation; true if it is to fail.
    pub(super) fn fails_allocation(&self, name: &str) -> bool {
        if let Some(names) = lock(&self.names).as_mut() {
            names.push(name.to_owned());
        }
        let number = self.allocations.fetch_add(1, Ordering::Relaxed) + 1;
        number == self.failing_allocation.load(Ordering::Relaxed)
    }

    /// Counts a submission; true once the device is lost.
    pub(super) fn loses_submission(&self) -> bool {
        let number = self.submissions.fetch_add(1, Ordering::Relaxed) + 1;
        if number == self.losing_submission.load(Ordering::Relaxed) {
            self.is_lost.store(true, Ordering::Relaxed);
        }
        self.is_lost()
    }

    /// Whether the device counts as lost.
    pub(super) fn is_lost(&self) -> bool {
        self.is_lost.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_allocation_fails_and_a_lost_device_stays_lost() {
        let faults = Faults::default();
        faults.fail_allocation(2);
        let failed: Vec<bool> = (0..4).map(|_| faults.fails_allocation("buffer")).collect();
        assert_eq!(failed, [false, true, false, false]);
        assert_eq!(faults.allocations(), ["buffer"; 4]);
        faults.lose_at_submission(2);
        let lost: Vec<bool> = (0..4).map(|_| faults.loses_submission()).collect();
        assert_eq!(lost, [false, true, true, true]);
    }
}
