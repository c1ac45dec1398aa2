//! Requests to a running training, by signals or from another thread.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use crate::Stop;

/// Requests that a run fulfils after the steps under way. Clones share their state.
#[derive(Clone, Debug, Default)]
pub struct Requests {
    /// 0, or 1 + the index in [`Stop::ALL`].
    stop: Arc<AtomicUsize>,
    save: Arc<AtomicBool>,
    finish: Arc<AtomicBool>,
    pause: Arc<AtomicBool>,
    snapshot: Arc<AtomicBool>,
}

impl Requests {
    /// Requests to save and stop.
    pub fn stop(&self, cause: Stop) {
        self.stop.store(Self::code(cause), Ordering::Relaxed);
    }

    /// Requests to save and continue.
    pub fn save(&self) {
        self.save.store(true, Ordering::Relaxed);
    }

    /// Requests to end soon: the cooldown begins, then the run is scored and complete.
    pub fn finish(&self) {
        self.finish.store(true, Ordering::Relaxed);
    }

    /// Whether the end was requested.
    pub(super) fn finishes(&self) -> bool {
        self.finish.load(Ordering::Relaxed)
    }

    /// Whether the end was requested since the last call; a pause is over then.
    pub(super) fn takes_finish(&self) -> bool {
        let is_asked = self.finish.swap(false, Ordering::Relaxed);
        if is_asked {
            self.pause(false);
        }
        is_asked
    }

    /// Requests to wait before the next steps, or no longer.
    pub fn pause(&self, waits: bool) {
        self.pause.store(waits, Ordering::Relaxed);
    }

    /// Whether the run is to wait.
    pub(crate) fn is_paused(&self) -> bool {
        self.pause.load(Ordering::Relaxed)
    }

    /// Requests the model as it is, in an [`Event::Snapshot`](super::Event::Snapshot).
    pub fn snapshot(&self) {
        self.snapshot.store(true, Ordering::Relaxed);
    }

    /// Whether a snapshot was requested since the last call.
    pub(crate) fn takes_snapshot(&self) -> bool {
        self.snapshot.swap(false, Ordering::Relaxed)
    }

    /// The cause of a request to stop, if there is one.
    pub(crate) fn stops(&self) -> Option<Stop> {
        let index = self.stop.load(Ordering::Relaxed).checked_sub(1)?;
        Stop::ALL.get(index).copied()
    }

    /// Whether a save was requested since the last call.
    pub(super) fn takes_save(&self) -> bool {
        self.save.swap(false, Ordering::Relaxed)
    }

    /// For signal handlers, which may only store a number: the flag for [`Requests::code`].
    pub(crate) fn stop_flag(&self) -> &Arc<AtomicUsize> {
        &self.stop
    }

    /// The number of a cause in [`Requests::stop_flag`].
    pub(crate) fn code(cause: Stop) -> usize {
        Stop::ALL.iter().position(|&stop| stop == cause).map_or(0, |index| index + 1)
    }

    /// The flag of [`Requests::save`], for signal handlers.
    pub(crate) fn save_flag(&self) -> &Arc<AtomicBool> {
        &self.save
    }

    /// The flag of [`Requests::finish`], for signal handlers.
    pub(crate) fn finish_flag(&self) -> &Arc<AtomicBool> {
        &self.finish
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cause_arrives_and_a_save_is_done_once() {
        let requests = Requests::default();
        assert_eq!((requests.stops(), requests.takes_save()), (None, false));
        for cause in Stop::ALL {
            requests.clone().stop(cause);
            assert_eq!(requests.stops(), Some(cause));
        }
        requests.save();
        assert!(requests.takes_save() && !requests.takes_save());
        requests.clone().snapshot();
        assert!(requests.takes_snapshot() && !requests.takes_snapshot());
        requests.clone().pause(true);
        assert!(requests.is_paused());
        requests.pause(false);
        assert!(!requests.is_paused());
        requests.pause(true);
        requests.finish();
        assert!(requests.finishes() && requests.takes_finish() && !requests.takes_finish());
        assert!(!requests.is_paused(), "a run that is to end does not wait");
    }
}
