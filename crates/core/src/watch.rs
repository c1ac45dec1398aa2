//! Following long work from any thread, and stopping it.

use std::cell::RefCell;
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use crate::{Error, Result};

/// How far watched work is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WatchedProgress {
    /// What is done: "decoding photographs", "compiling kernels", "training".
    pub stage: &'static str,
    /// Parts of the stage that are done.
    pub done: usize,
    /// Parts in all.
    pub all: usize,
}

/// Follows work, and stops it from any thread. Clones are the same watch.
///
/// ```
/// use nightsplat_core::watch::{Stage, Watch};
///
/// let watch = Watch::new(|progress| println!("{progress:?}"));
/// let stops = watch.clone();
/// std::thread::spawn(move || stops.stop()).join().unwrap();
/// let done = watch.during(|| Stage::begin("baking", 2).next());
/// assert!(done.is_err());
/// ```
#[derive(Clone, Default)]
pub struct Watch(Arc<Shared>);

/// What is told of progress.
type Report = Box<dyn FnMut(WatchedProgress) + Send>;

#[derive(Default)]
struct Shared {
    is_stopped: AtomicBool,
    report: Option<Mutex<Report>>,
}

thread_local! {
    /// Of the work that this thread does.
    static CURRENT: RefCell<Watch> = RefCell::default();
}

impl Watch {
    /// A watch that is told of progress, by one thread at a time but not always by the same.
    pub fn new(report: impl FnMut(WatchedProgress) + Send + 'static) -> Self {
        let report = Some(Mutex::new(Box::new(report) as Report));
        Self(Arc::new(Shared { is_stopped: AtomicBool::new(false), report }))
    }

    /// Ends the work that is watched, or the next, with [`Error::Halted`]. The watch may be used again afterwards.
    pub fn stop(&self) {
        self.0.is_stopped.store(true, Ordering::Relaxed);
    }

    /// Whether it was stopped.
    pub fn is_stopped(&self) -> bool {
        self.0.is_stopped.load(Ordering::Relaxed)
    }

    /// Does work on this thread that this watch follows.
    ///
    /// # Errors
    /// Those of the work, and [`Error::Halted`] where it was stopped.
    pub fn during<T>(&self, work: impl FnOnce() -> Result<T>) -> Result<T> {
        let done = self.within(work);
        if matches!(done, Err(Error::Halted { .. })) {
            self.0.is_stopped.store(false, Ordering::Relaxed);
        }
        done
    }

    /// Does a part of watched work on another thread.
    #[doc(hidden)]
    pub fn within<T>(&self, work: impl FnOnce() -> T) -> T {
        let _before = Restored(CURRENT.replace(self.clone()));
        work()
    }

    /// That of the work of this thread; one without a follower where there is none.
    #[doc(hidden)]
    pub fn current() -> Self {
        CURRENT.with_borrow(Self::clone)
    }

    fn tell(&self, progress: WatchedProgress) {
        if let Some(report) = &self.0.report {
            report.lock().unwrap_or_else(PoisonError::into_inner)(progress);
        }
    }
}

impl fmt::Debug for Watch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Watch").field("is_stopped", &self.is_stopped()).finish_non_exhaustive()
    }
}

/// The watch that a thread had before, also where its work panics.
struct Restored(Watch);

impl Drop for Restored {
    fn drop(&mut self) {
        CURRENT.replace(std::mem::take(&mut self.0));
    }
}

/// A stage of the work of a thread, whose parts any threads do.
#[doc(hidden)]
#[derive(Debug)]
pub struct Stage {
    watch: Watch,
    name: &'static str,
    done: AtomicUsize,
    all: usize,
}

impl Stage {
    /// A stage of `all` parts.
    pub fn begin(name: &'static str, all: usize) -> Self {
        Self::after(name, 0, all)
    }

    /// A stage of which `done` parts are done.
    pub fn after(name: &'static str, done: usize, all: usize) -> Self {
        Self { watch: Watch::current(), name, done: AtomicUsize::new(done), all }
    }

    /// Before a part: tells of those that are done, or ends the work.
    ///
    /// # Errors
    /// [`Error::Halted`] where the watch was stopped.
    pub fn next(&self) -> Result<()> {
        let done = self.done.fetch_add(1, Ordering::Relaxed);
        self.at(done)
    }

    /// The same where `done` parts are done.
    ///
    /// # Errors
    /// As [`Stage::next`].
    pub fn at(&self, done: usize) -> Result<()> {
        if self.watch.is_stopped() {
            return Err(Error::Halted { stage: self.name });
        }
        self.watch.tell(WatchedProgress { stage: self.name, done, all: self.all });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_watch_follows_all_threads_of_its_work_and_stops_them_once() {
        let told = Arc::new(Mutex::new(vec![]));
        let list = Arc::clone(&told);
        let watch = Watch::new(move |progress| list.lock().unwrap().push(progress.done));
        let work = || {
            let stage = Stage::begin("work", 8);
            std::thread::scope(|scope| {
                let parts = || (0..4).try_for_each(|_| stage.next());
                let other = scope.spawn(parts);
                parts().and(other.join().unwrap())
            })
        };
        watch.during(work).unwrap();
        told.lock().unwrap().sort_unstable();
        assert_eq!(*told.lock().unwrap(), (0..8).collect::<Vec<_>>());
        watch.stop();
        let halted = watch.during(work).unwrap_err();
        assert_eq!(halted.to_string(), "stopped on request while work");
        watch.during(work).unwrap();
        // Other work is not followed.
        watch.stop();
        work().unwrap();
        assert_eq!(told.lock().unwrap().len(), 16);
    }
}
