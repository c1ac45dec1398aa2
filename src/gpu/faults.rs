//! Injected faults: the n-th allocation finds no memory, the device is lost from the n-th submission on, a check of the
//! self-test fails, or the driver refuses a kernel or crashes when it compiles one.
//!
//! Tests inject them into a [`Gpu`](super::Gpu), or into a process by the variable `NIGHTSPLAT_FAULT` (`allocation:17`,
//! `submission:5`, counted from 1; `self_test:0`, by the check's number; `refuse:KERNEL`,
//! `crash:KERNEL`).

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use super::lock;
use crate::{Error, Result};

const VARIABLE: &str = "NIGHTSPLAT_FAULT";

/// Counts so far, and the count that fails; 0: none.
#[derive(Debug, Default)]
pub struct Faults {
    allocations: AtomicU64,
    failing_allocation: AtomicU64,
    /// The names of the allocated buffers, where a test records them.
    names: Mutex<Option<Vec<String>>>,
    /// Nothing is counted, and nothing fails but what the self-test checks.
    is_paused: AtomicBool,
    submissions: AtomicU64,
    losing_submission: AtomicU64,
    is_lost: AtomicBool,
    /// The check of the self-test that fails.
    planted_check: Mutex<Option<u32>>,
    refused_kernel: Option<String>,
    crashing_kernel: Option<String>,
}

impl Faults {
    pub(super) fn from_environment() -> Result<Self> {
        let mut faults = Self::default();
        let Ok(text) = std::env::var(VARIABLE) else { return Ok(faults) };
        if let Some(kernel) = text.strip_prefix("refuse:") {
            faults.refused_kernel = Some(kernel.to_owned());
            return Ok(faults);
        }
        if let Some(kernel) = text.strip_prefix("crash:") {
            faults.crashing_kernel = Some(kernel.to_owned());
            return Ok(faults);
        }
        let number = |text: &str| text.parse::<u64>().ok();
        match text.split_once(':').map(|(what, number_of)| (what, number(number_of))) {
            Some(("allocation", Some(number @ 1..))) => {
                faults.failing_allocation.store(number, Ordering::Relaxed);
            }
            Some(("submission", Some(number @ 1..))) => faults.lose_at_submission(number),
            Some(("self_test", Some(number))) => faults.plant_check(Some(number as u32)),
            _ => {
                let faults =
                    "allocation:N, submission:N, self_test:N, refuse:KERNEL or crash:KERNEL";
                let problem = format!("{VARIABLE}={text}; it is for tests: {faults}");
                return Err(Error::Usage(problem));
            }
        }
        Ok(faults)
    }

    /// Fails the allocation with this number, counted from 1 now on.
    pub fn fail_allocation(&self, number: u64) {
        *lock(&self.names) = Some(vec![]);
        self.allocations.store(0, Ordering::Relaxed);
        self.failing_allocation.store(number, Ordering::Relaxed);
    }

    /// Loses the device at the submission with this number, counted from 1 now on.
    pub fn lose_at_submission(&self, number: u64) {
        self.submissions.store(0, Ordering::Relaxed);
        self.losing_submission.store(number, Ordering::Relaxed);
    }

    /// What a driver does that has to compile this kernel.
    pub(super) fn compile(&self, kernel: &str) -> Result<(), ash::vk::Result> {
        if self.crashing_kernel.as_deref() == Some(kernel) {
            std::process::abort();
        }
        match self.refused_kernel.as_deref() == Some(kernel) {
            true => Err(ash::vk::Result::ERROR_UNKNOWN),
            false => Ok(()),
        }
    }

    /// Fails this check of the self-test.
    pub fn plant_check(&self, check: Option<u32>) {
        *lock(&self.planted_check) = check;
    }

    /// The check of the self-test that fails.
    pub fn planted_check(&self) -> Option<u32> {
        *lock(&self.planted_check)
    }

    /// The names of the buffers allocated since [`Self::fail_allocation`], in order.
    pub fn allocations(&self) -> Vec<String> {
        lock(&self.names).take().unwrap_or_default()
    }

    /// Counts an allocation; true if it is to fail.
    pub(super) fn fails_allocation(&self, name: &str) -> bool {
        if self.is_paused.load(Ordering::Relaxed) {
            return false;
        }
        if let Some(names) = lock(&self.names).as_mut() {
            names.push(name.to_owned());
        }
        let number = self.allocations.fetch_add(1, Ordering::Relaxed) + 1;
        number == self.failing_allocation.load(Ordering::Relaxed)
    }

    /// Counts a submission; true once the device is lost.
    pub(super) fn loses_submission(&self) -> bool {
        if self.is_paused.load(Ordering::Relaxed) {
            return self.is_lost();
        }
        let number = self.submissions.fetch_add(1, Ordering::Relaxed) + 1;
        if number == self.losing_submission.load(Ordering::Relaxed) {
            self.is_lost.store(true, Ordering::Relaxed);
        }
        self.is_lost()
    }

    pub(super) fn pause(&self, is_paused: bool) {
        self.is_paused.store(is_paused, Ordering::Relaxed);
    }

    /// Whether the device counts as lost.
    pub(super) fn is_lost(&self) -> bool {
        self.is_lost.load(Ordering::Relaxed)
    }
}
