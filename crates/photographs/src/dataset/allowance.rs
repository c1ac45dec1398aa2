//! A limit on the memory that loading may use.

use std::sync::atomic::{AtomicU64, Ordering};

/// Bytes of memory that threads share.
#[derive(Debug)]
pub(super) struct Allowance(AtomicU64);

impl Allowance {
    pub(super) fn new(bytes: u64) -> Self {
        Self(AtomicU64::new(bytes))
    }

    /// Takes `bytes` if they are available.
    pub(super) fn take(&self, bytes: u64) -> bool {
        let left_after = |left: u64| left.checked_sub(bytes);
        self.0.fetch_update(Ordering::Relaxed, Ordering::Relaxed, left_after).is_ok()
    }
}
