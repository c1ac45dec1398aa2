//! Progress of a COLMAP command, read from its output.

use std::time::{Duration, Instant};

/// Time between two lines about one command.
const INTERVAL: Duration = Duration::from_secs(10);

/// The progress of a running command, as a line every few seconds.
pub(super) struct StageProgress<'a> {
    what: &'a str,
    photographs: usize,
    last: Instant,
}

impl<'a> StageProgress<'a> {
    /// Starts a stage on this number of photographs; `what` begins its lines.
    pub(super) fn new(what: &'a str, photographs: usize) -> Self {
        Self { what, photographs, last: Instant::now() }
    }

    /// The next line if it is due, from the output so far.
    pub(super) fn due(&mut self, printed: &str) -> Option<String> {
        if self.last.elapsed() < INTERVAL {
            return None;
        }
        self.last = Instant::now();
        let how_far = match counted(printed, self.photographs) {
            Some([at, of]) => format!("{at} of {of}"),
            None => "at work".to_owned(),
        };
        Some(format!("{}: {how_far}", self.what))
    }
}

/// The last count that COLMAP printed, and the total: files as [3/48], blocks of pairs as [1/6, 2/6], and photographs
/// that the current model has, as "Registering image #9 (4)".
fn counted(printed: &str, photographs: usize) -> Option<[usize; 2]> {
    let bracket = |line: &str| {
        let inside = line.split_once('[')?.1.split_once(']')?.0;
        let pairs = inside.split(',').map(|pair| {
            let (at, of) = pair.trim().split_once('/')?;
            Some([at.parse::<usize>().ok()?, of.parse::<usize>().ok()?])
        });
        let pairs = pairs.collect::<Option<Vec<_>>>()?;
        match *pairs.as_slice() {
            [[at, of]] => Some([at, of]),
            [[row, rows], [column, columns]] => {
                Some([row.saturating_sub(1) * columns + column, rows * columns])
            }
            _ => None,
        }
    };
    let registered = |line: &str| {
        let inside =
            line.split_once("Registering image #")?.1.split_once('(')?.1.split_once(')')?.0;
        // COLMAP from 3.12 on names the number.
        let count: usize =
            inside.trim_start_matches(|letter: char| !letter.is_ascii_digit()).parse().ok()?;
        Some([count.min(photographs), photographs])
    };
    let lines = || printed.lines().rev();
    lines().find_map(registered).or_else(|| lines().find_map(bracket))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_read_from_the_output_of_colmap() {
        let cases = [
            (
                "Processed file [2/48]\n  Name: a\nProcessed file [3/48]\n  Features: 8",
                Some([3, 48]),
            ),
            ("Matching block [2/6, 5/6] in 0.1s\nI2026 Matching block [3/6, 1/6]", Some([13, 36])),
            ("Matching image [7/20] in", Some([7, 20])),
            ("Registering image #4 (3)\n x [1/2]\nRegistering image #9 (4)\n", Some([4, 24])),
            ("I2026] Registering image #4 (num_reg_frames=3)", Some([3, 24])),
            ("Registering image #9 (24)\nRegistering image #3 (25)\n => failed", Some([24, 24])),
            ("Registering image #9 (24)\nInitializing\nRegistering image #1 (3)", Some([3, 24])),
            ("[no/count]\nnothing [", None),
        ];
        for (printed, expected) in cases {
            assert_eq!(counted(printed, 24), expected, "{printed}");
        }
        let mut stage = StageProgress::new("matching", 24);
        assert_eq!(stage.due("Matching block [1/1, 1/1]"), None, "too early");
        stage.last = Instant::now().checked_sub(INTERVAL).unwrap();
        assert_eq!(stage.due("Matching block [1/2, 1/2]").unwrap(), "matching: 1 of 4");
        stage.last = Instant::now().checked_sub(INTERVAL).unwrap();
        assert_eq!(stage.due("").unwrap(), "matching: at work");
    }
}
