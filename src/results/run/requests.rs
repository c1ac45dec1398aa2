//! What is asked of a run while it trains: by signals, or from another thread.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use crate::Stop;

/// Wishes that a run fulfils at the end of the steps under way. Clones are the same wishes.
#[derive(Clone, Debug, Default)]
pub struct Requests {
    /// 0, or 1 more than the place in [`STOPS`].
    stop: Arc<AtomicUsize>,
    save: Arc<AtomicBool>,
}

const STOPS: [Stop; 3] = [Stop::Interrupted, Stop::Terminated, Stop::TimeUp];

impl Requests {
    /// Asks to save and stop.
    #[cfg(feature = "testing")]
    pub fn stop(&self, cause: Stop) {
        self.stop.store(Self::code(cause), Ordering::Relaxed);
    }

    /// Asks to save and go on.
    #[cfg(feature = "testing")]
    pub fn save(&self) {
        self.save.store(true, Ordering::Relaxed);
    }

    /// What asked to stop, if anything did.
    pub(crate) fn stops(&self) -> Option<Stop> {
        let place = self.stop.load(Ordering::Relaxed).checked_sub(1)?;
        STOPS.get(place).copied()
    }

    /// Whether somebody asked to save since this was asked last.
    pub(super) fn takes_save(&self) -> bool {
        self.save.swap(false, Ordering::Relaxed)
    }

    /// For signal handlers, which may store a number and nothing more: where, and the number of a cause.
    pub(crate) fn stop_flag(&self) -> &Arc<AtomicUsize> {
        &self.stop
    }

    /// The number that stands for a cause in [`Requests::stop_flag`].
    pub(crate) fn code(cause: Stop) -> usize {
        STOPS.iter().position(|&stop| stop == cause).map_or(0, |place| place + 1)
    }

    /// As [`Requests::stop_flag`], of [`Requests::save`].
    pub(crate) fn save_flag(&self) -> &Arc<AtomicBool> {
        &self.save
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cause_arrives_and_a_save_is_done_once() {
        let requests = Requests::default();
        assert_eq!((requests.stops(), requests.takes_save()), (None, false));
        for cause in STOPS {
            requests.clone().stop(cause);
            assert_eq!(requests.stops(), Some(cause));
        }
        requests.save();
        assert!(requests.takes_save() && !requests.takes_save());
    }
}
