//! How far COLMAP is, by what it says.

use std::time::{Duration, Instant};

/// Between two lines about one command.
const PAUSE: Duration = Duration::from_secs(10);

/// A command at work, which says every few seconds how far it is.
pub(super) struct Stage<'a> {
    what: &'a str,
    last: Instant,
}

impl<'a> Stage<'a> {
    /// `what` it does, in a few words.
    pub(super) fn new(what: &'a str) -> Self {
        Self { what, last: Instant::now() }
    }

    /// The line that is due, by what the command has said.
    pub(super) fn due(&mut self, printed: &str) -> Option<String> {
        if self.last.elapsed() < PAUSE {
            return None;
        }
        self.last = Instant::now();
        let how_far = counted(printed).map_or_else(
            || "at work".to_owned(),
            |[at, of]| match of {
                0 => format!("{at} so far"),
                _ => format!("{at} of {of}"),
            },
        );
        Some(format!("{}: {how_far}", self.what))
    }
}

/// The last count that COLMAP printed: files as [3/48], blocks of pairs as [1/6, 2/6], registered photographs by a
/// line each, of which it does not say the total: 0.
fn counted(printed: &str) -> Option<[usize; 2]> {
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
    let registered = printed.lines().filter(|line| line.contains("Registering image #")).count();
    let by_line = printed.lines().rev().find_map(bracket);
    if registered > 0 { Some([registered, 0]) } else { by_line }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_read_off_what_colmap_says() {
        let cases = [
            (
                "Processed file [2/48]\n  Name: a\nProcessed file [3/48]\n  Features: 8",
                Some([3, 48]),
            ),
            ("Matching block [2/6, 5/6] in 0.1s\nI2026 Matching block [3/6, 1/6]", Some([13, 36])),
            ("Matching image [7/20] in", Some([7, 20])),
            ("Registering image #4 (3)\n x [1/2]\nRegistering image #9 (4)\n", Some([2, 0])),
            ("[no/count]\nnothing [", None),
        ];
        for (printed, expected) in cases {
            assert_eq!(counted(printed), expected, "{printed}");
        }
        let mut stage = Stage::new("matching");
        assert_eq!(stage.due("Matching block [1/1, 1/1]"), None, "too early");
        stage.last = Instant::now().checked_sub(PAUSE).unwrap();
        assert_eq!(stage.due("Matching block [1/2, 1/2]").unwrap(), "matching: 1 of 4");
        stage.last = Instant::now().checked_sub(PAUSE).unwrap();
        assert_eq!(stage.due("").unwrap(), "matching: at work");
    }
}
