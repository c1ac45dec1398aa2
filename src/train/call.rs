//! A call that trains: its time, and the scores of views that it leaves to the next.
//!
//! What is due after a step ends with a call whose time is over, and begins anew in the next: views that were scored
//! already are not scored again. An action that does not end changes nothing, so its parts give the same bits as the
//! whole.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use nightsplat_core::watch::Stage;

use crate::{Error, Result};

/// What views are scored for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Scored {
    /// The best model, and convergence.
    Model,
    /// The end of growth.
    Growth,
    /// A decision on the SH degree, of the model with this degree.
    Degree(u32),
    /// The probes before a round of density control.
    Before,
    /// The probes after a trial of it, by number.
    After(u32),
}

/// A call, and the scores so far of what is due.
#[derive(Debug)]
pub(super) struct Call {
    pub(super) begin: Instant,
    /// `None`: what is due is done as a whole.
    budget: Option<Duration>,
    /// Whether it has done anything, as every call does.
    pub(super) has_worked: bool,
    /// Whether its time was over before what is due was done.
    pub(super) is_over: bool,
    /// The longest time that a view took.
    longest: Duration,
    scores: BTreeMap<Scored, Vec<[f64; 2]>>,
}

impl Default for Call {
    fn default() -> Self {
        Self {
            begin: Instant::now(),
            budget: None,
            has_worked: false,
            is_over: false,
            longest: Duration::ZERO,
            scores: BTreeMap::new(),
        }
    }
}

impl Call {
    /// Begins the next.
    pub(super) fn next(&mut self, budget: Option<Duration>) {
        let (longest, scores) = (self.longest, std::mem::take(&mut self.scores));
        *self = Self { budget, longest, scores, ..Self::default() };
    }

    /// Whether its time is not over.
    pub(super) fn has_time(&self) -> bool {
        self.budget.is_none_or(|budget| self.begin.elapsed() < budget)
    }

    /// What these scores were for is decided: the next ones are of another model.
    pub(super) fn decided(&mut self, what: Scored) {
        self.scores.remove(&what);
    }

    /// All that was due is done.
    pub(super) fn settle(&mut self) {
        self.scores.clear();
    }

    /// The scores of `views`, of which those of earlier calls are known.
    ///
    /// # Errors
    /// Those of a score; [`Error::Halted`] where the time is over or the watch was stopped.
    pub(super) fn scores<V>(
        &mut self,
        what: Scored,
        views: &[V],
        mut score: impl FnMut(&V) -> Result<[f64; 2]>,
    ) -> Result<Vec<[f64; 2]>> {
        const STAGE: &str = "scoring views";
        let mut known = self.scores.remove(&what).unwrap_or_default();
        let stage = Stage::after(STAGE, known.len(), views.len());
        let rest = views.get(known.len()..).unwrap_or_default();
        let scored = rest.iter().try_for_each(|view| {
            stage.next()?;
            let is_late = |budget| self.begin.elapsed() + self.longest > budget;
            if self.has_worked && self.budget.is_some_and(is_late) {
                self.is_over = true;
                return Err(Error::Halted { stage: STAGE });
            }
            let begin = Instant::now();
            known.push(score(view)?);
            self.longest = self.longest.max(begin.elapsed());
            self.has_worked = true;
            Ok(())
        });
        self.scores.insert(what, known.clone());
        scored.map(|()| known)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_call_without_time_scores_one_view_and_leaves_the_rest_to_the_next() {
        let (mut call, mut scored) = (Call::default(), vec![]);
        for round in 1..=4 {
            call.next(Some(Duration::ZERO));
            let done = call.scores(Scored::Model, &[1.0, 2.0, 4.0, 8.0], |&view| {
                scored.push(view);
                Ok([view, 0.0])
            });
            match round {
                4 => assert_eq!(done.unwrap().len(), 4),
                _ => assert!(matches!(done, Err(Error::Halted { .. })) && call.is_over),
            }
        }
        assert_eq!(scored, [1.0, 2.0, 4.0, 8.0]);
        call.settle();
        call.next(None);
        let again = call.scores(Scored::Model, &[1.0, 2.0], |&view| Ok([2.0 * view, 0.0])).unwrap();
        assert_eq!(again, [[2.0, 0.0], [4.0, 0.0]]);
    }
}
