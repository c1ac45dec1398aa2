//! What is said of the colours of many photographs: a line for each colour space, not for each file.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use super::Conversion;

/// Counts conversions, from any thread.
#[derive(Debug, Default)]
pub(crate) struct ColourTally(Mutex<Counts>);

#[derive(Debug, Default)]
struct Counts {
    /// By colour space: photographs, and the sum of the fractions of their pixels that sRGB does not hold.
    converted: BTreeMap<String, (usize, f64)>,
    /// By what is not understood.
    unknown: BTreeMap<String, usize>,
}

/// The fraction of pixels outside sRGB that is worth a warning.
const SMALL: f64 = 0.01;

impl ColourTally {
    /// Counts a photograph.
    pub(crate) fn add(&self, conversion: Conversion) {
        let mut counts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((space, outside)) = conversion.from {
            let (count, sum) = counts.converted.entry(space).or_default();
            *count += 1;
            *sum += outside;
        }
        if let Some(problem) = conversion.unknown {
            *counts.unknown.entry(problem).or_default() += 1;
        }
    }

    /// Says what was counted.
    pub(crate) fn say(&self) {
        let counts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (notes, warnings) = counts.lines();
        notes.iter().for_each(|line| tracing::info!("{line}"));
        warnings.iter().for_each(|line| tracing::warn!("{line}"));
    }
}

impl Counts {
    /// What was converted, and what is wrong.
    fn lines(&self) -> (Vec<String>, Vec<String>) {
        let converted = |(space, (count, _)): (&String, &(usize, f64))| {
            format!("{} in {space} converted to sRGB", photographs(*count))
        };
        let clipped = self.converted.iter().filter_map(|(space, &(count, sum))| {
            let outside = sum / count as f64;
            let percent = 100.0 * outside;
            let whose = photographs(count);
            (outside > SMALL)
                .then(|| format!("{percent:.0} % of the pixels of {whose} in {space} lie outside sRGB and are clipped to it"))
        });
        let unknown = |(problem, count): (&String, &usize)| {
            let whose = photographs(*count);
            format!(
                "{whose} with {problem}: the colours are read as sRGB; convert the files to sRGB if they are not"
            )
        };
        let warnings = clipped.chain(self.unknown.iter().map(unknown)).collect();
        (self.converted.iter().map(converted).collect(), warnings)
    }
}

fn photographs(count: usize) -> String {
    format!("{count} photograph{}", if count == 1 { "" } else { "s" })
}
