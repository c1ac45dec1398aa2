//! Progress of a COLMAP command, read from its output.

use std::time::{Duration, Instant};

use nightsplat_core::output::about;

/// Time between two lines about one command.
const INTERVAL: Duration = Duration::from_secs(10);

/// The progress of a running command, as a line every few seconds.
pub(super) struct StageProgress<'a> {
    what: &'a str,
    photographs: usize,
    begin: Instant,
    last: Instant,
    /// The first count, which an earlier call may have reached.
    first: Option<usize>,
}

impl<'a> StageProgress<'a> {
    /// Starts a stage on this number of photographs; `what` begins its lines.
    pub(super) fn new(what: &'a str, photographs: usize) -> Self {
        let now = Instant::now();
        Self { what, photographs, begin: now, last: now, first: None }
    }

    /// The next line if it is due, from the output so far.
    pub(super) fn due(&mut self, printed: &str) -> Option<String> {
        if self.last.elapsed() < INTERVAL {
            return None;
        }
        self.last = Instant::now();
        let how_far = match counted(printed, self.photographs) {
            Some([at, of]) => {
                let done = at.saturating_sub(*self.first.get_or_insert(at));
                let left = self.begin.elapsed().as_secs_f64() * (of - at) as f64 / done as f64;
                let left = (done > 0).then(|| format!(", {} left", about(left)));
                format!("{at} of {of}{}", left.unwrap_or_default())
            }
            None => "at work".to_owned(),
        };
        Some(format!("{}: {how_far}", self.what))
    }
}

/// The last count that COLMAP printed, and the total, which no count exceeds: files as [3/48], blocks of pairs as
/// [1/6, 2/6], and photographs that the current model has.
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
    let in_model = registered(printed).map(|count| [count, photographs]);
    let found = in_model.or_else(|| printed.lines().rev().find_map(bracket));
    found.map(|[at, of]| [at.min(of), of])
}

/// The photographs that the current model has, by lines such as "Registering image #9 (4)", which tries a fourth.
fn registered(printed: &str) -> Option<usize> {
    let mut count = None;
    for line in printed.lines() {
        if line.contains("Initializing with image pair") {
            count = Some(2);
        } else if let Some((_, attempt)) = line.split_once("Registering image #") {
            let inside = attempt.split_once('(').and_then(|(_, rest)| rest.split_once(')'));
            // COLMAP from 3.12 on names the number.
            let number = inside.map(|(inside, _)| {
                inside.trim_start_matches(|letter: char| !letter.is_ascii_digit())
            });
            count = number.and_then(|number| number.parse().ok()).or(count);
        } else if line.contains("Could not register") {
            count = count.map(|count: usize| count.saturating_sub(1));
        }
    }
    count
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
            ("Registering image #9 (24)\nInitializing with image pair #1 and #5", Some([2, 24])),
            (
                "Registering image #9 (4)\n  => Could not register, trying another image.\n\
                 Registering image #2 (4)\n  => Could not register, trying another image.",
                Some([3, 24]),
            ),
            ("Processed file [50/48]", Some([48, 48])),
            ("[no/count]\nnothing [", None),
        ];
        for (printed, expected) in cases {
            assert_eq!(counted(printed, 24), expected, "{printed}");
        }
        let mut stage = StageProgress::new("matching", 24);
        assert_eq!(stage.due("Matching block [1/1, 1/1]"), None, "too early");
        stage.last = Instant::now().checked_sub(INTERVAL).unwrap();
        stage.begin = Instant::now().checked_sub(Duration::from_secs(35)).unwrap();
        assert_eq!(stage.due("Matching block [1/2, 1/2]").unwrap(), "matching: 1 of 4");
        stage.last = Instant::now().checked_sub(INTERVAL).unwrap();
        let line = "matching: 2 of 4, about 80 s left";
        assert_eq!(stage.due("Matching block [1/2, 2/2]").unwrap(), line);
        stage.last = Instant::now().checked_sub(INTERVAL).unwrap();
        assert_eq!(stage.due("").unwrap(), "matching: at work");
    }
}
