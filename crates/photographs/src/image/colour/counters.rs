//! Reports the colours of a set of photographs, which share their levels: one line for each colour space, not for each
//! file.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use super::super::levels::Levels;
use super::Conversion;

/// Counts conversions, thread-safe.
#[derive(Debug)]
pub struct ColourCounts {
    /// The name of the counted items, in the singular.
    what: &'static str,
    /// With which all of them are decoded.
    levels: Levels,
    counts: Mutex<Counts>,
}

impl Default for ColourCounts {
    fn default() -> Self {
        Self::new("photograph")
    }
}

#[derive(Debug, Default)]
struct Counts {
    /// By colour space: the number of photographs, and the sum of their fractions of pixels outside sRGB.
    converted: BTreeMap<String, (usize, f64)>,
    /// By the metadata that cannot be used.
    unknown: BTreeMap<String, usize>,
    /// What is unusual about the values of a file.
    remarks: BTreeSet<String>,
    /// A value was beyond the levels.
    is_beyond: bool,
}

/// The fraction of pixels outside sRGB that is worth a warning.
const SMALL: f64 = 0.01;

impl ColourCounts {
    /// For items of this name.
    pub fn new(what: &'static str) -> Self {
        Self { what, levels: Levels::default(), counts: Mutex::default() }
    }

    /// For photographs of these levels.
    pub fn of_levels(levels: Levels) -> Self {
        Self { levels, ..Self::default() }
    }

    /// The levels.
    pub fn levels(&self) -> Levels {
        self.levels
    }

    /// Whether a value was beyond the levels: they are not those of the set.
    pub fn is_beyond(&self) -> bool {
        self.counts.lock().unwrap_or_else(PoisonError::into_inner).is_beyond
    }

    /// Counts a photograph.
    pub(in super::super) fn add(
        &self,
        path: &Path,
        conversion: Conversion,
        remark: Option<String>,
        is_beyond: bool,
    ) {
        let mut counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        counts.is_beyond |= is_beyond;
        counts.remarks.extend(remark.map(|remark| format!("{}: {remark}", path.display())));
        drop(counts);
        self.count(conversion);
    }

    /// Counts a conversion.
    pub(super) fn count(&self, conversion: Conversion) {
        let mut counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((space, outside)) = conversion.from {
            let (count, sum) = counts.converted.entry(space).or_default();
            *count += 1;
            *sum += outside;
        }
        if let Some(problem) = conversion.unknown {
            *counts.unknown.entry(problem).or_default() += 1;
        }
    }

    /// Logs the counts.
    pub fn log(&self) {
        self.lines().iter().for_each(|line| tracing::warn!("{line}"));
    }

    pub(super) fn lines(&self) -> Vec<String> {
        let counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        let these =
            |count: usize| format!("{count} {}{}", self.what, if count == 1 { "" } else { "s" });
        let mut lines: Vec<String> = counts.remarks.iter().cloned().collect();
        for (space, &(count, sum)) in &counts.converted {
            let (whose, outside) = (these(count), sum / count as f64);
            lines.push(format!("{whose} in {space} converted to sRGB"));
            if outside > SMALL {
                let percent = 100.0 * outside;
                lines.push(format!(
                    "{percent:.0} % of the pixels of {whose} in {space} are outside sRGB and clipped"
                ));
            }
        }
        for (problem, &count) in &counts.unknown {
            let whose = these(count);
            lines.push(format!(
                "{whose} with {problem}, which is not used; convert the files if their colours are not sRGB"
            ));
        }
        lines
    }
}
