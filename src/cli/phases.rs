//! Seconds of the phases of a command: the spans of its main thread, which `-v` turns on.

use std::cell::RefCell;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use tracing::span::Id;
use tracing::{Level, Metadata, Subscriber};
use tracing_subscriber::filter::{FilterFn, LevelFilter, filter_fn};
use tracing_subscriber::layer::{Context, Layer};
use tracing_subscriber::registry::LookupSpan;

/// The phases in the order of their ends, each without the phases within it.
static SECONDS: Mutex<Vec<(&str, Duration)>> = Mutex::new(vec![]);

thread_local! {
    /// Of the thread that measures.
    static CLOCK: RefCell<Option<Clock>> = const { RefCell::new(None) };
}

struct Clock {
    begin: Instant,
    /// The last change of phase.
    changed: Instant,
    /// The phase, and those around it.
    open: Vec<&'static str>,
}

/// Sums the times of spans by name.
#[derive(Debug)]
pub struct Phases(());

impl Phases {
    /// Measures the spans of the calling thread from now on.
    pub fn begin() -> Self {
        let now = Instant::now();
        CLOCK.set(Some(Clock { begin: now, changed: now, open: vec![] }));
        Self(())
    }

    /// The spans that are phases.
    pub fn filter() -> FilterFn {
        let is_phase = |metadata: &Metadata<'_>| {
            metadata.is_span()
                && *metadata.level() == Level::INFO
                && metadata.target().starts_with("nightsplat")
        };
        filter_fn(is_phase as fn(&Metadata<'_>) -> bool).with_max_level_hint(LevelFilter::INFO)
    }
}

impl<S: Subscriber + for<'a> LookupSpan<'a>> Layer<S> for Phases {
    fn on_enter(&self, id: &Id, spans: Context<'_, S>) {
        if let Some(span) = spans.metadata(id) {
            change(|open| open.push(span.name()));
        }
    }

    fn on_exit(&self, _: &Id, _: Context<'_, S>) {
        change(|open| {
            open.pop();
        });
    }
}

/// Adds the time since the last change to the phase that ends or is interrupted.
fn change(to: impl FnOnce(&mut Vec<&'static str>)) {
    CLOCK.with_borrow_mut(|clock| {
        let Some(Clock { changed, open, .. }) = clock else { return };
        let now = Instant::now();
        if let Some(&phase) = open.last() {
            let mut seconds = SECONDS.lock().unwrap_or_else(PoisonError::into_inner);
            let at = seconds.iter().position(|(name, _)| *name == phase).unwrap_or_else(|| {
                seconds.push((phase, Duration::ZERO));
                seconds.len() - 1
            });
            seconds[at].1 += now - *changed;
        }
        *changed = now;
        to(open);
    });
}

/// The phases so far, the time in none, and all of it; empty if nothing measures this thread.
pub(super) fn seconds() -> Vec<(&'static str, f64)> {
    let Some(all) = CLOCK.with_borrow(|clock| Some(clock.as_ref()?.begin.elapsed())) else {
        return vec![];
    };
    let known = SECONDS.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let in_none = all.saturating_sub(known.iter().map(|(_, seconds)| *seconds).sum());
    let phases = known.into_iter().chain([("other", in_none), ("all", all)]);
    phases.map(|(name, seconds)| (name, seconds.as_secs_f64())).collect()
}

/// Logs them, if they are measured.
pub(super) fn log() {
    let phases = seconds();
    if !phases.is_empty() {
        let list = phases.iter().map(|(name, seconds)| format!("{name} {seconds:.3}"));
        tracing::info!("seconds: {}", list.collect::<Vec<_>>().join(", "));
    }
}

#[cfg(test)]
mod tests {
    use tracing_subscriber::prelude::*;

    use super::*;

    #[test]
    fn a_phase_has_the_time_of_its_thread_without_the_phases_within_it() {
        let wait = |milliseconds| std::thread::sleep(Duration::from_millis(milliseconds));
        assert!(seconds().is_empty());
        let layer = Phases::begin().with_filter(Phases::filter());
        tracing::subscriber::with_default(tracing_subscriber::registry().with(layer), || {
            for _ in 0..2 {
                let _outer = tracing::info_span!("outer").entered();
                wait(20);
                let _inner = tracing::info_span!("inner").entered();
                wait(60);
            }
            let _finer = tracing::debug_span!("finer").entered();
            std::thread::spawn(|| tracing::info_span!("elsewhere").in_scope(|| ())).join().unwrap();
        });
        let phases = seconds();
        let names: Vec<&str> = phases.iter().map(|(name, _)| *name).collect();
        assert_eq!(names, ["outer", "inner", "other", "all"]);
        let [outer, inner, other, all] = [0, 1, 2, 3].map(|at| phases[at].1);
        assert!(outer >= 0.04 && inner >= 0.12 && inner > outer, "{phases:?}");
        assert!((outer + inner + other - all).abs() < 1e-6, "{phases:?}");
    }
}
