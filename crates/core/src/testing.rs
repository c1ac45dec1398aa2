//! Tests of all crates say what they lack.

use std::fmt::Display;
use std::io::Write;
use std::panic::Location;

/// The variable with what tests must not go without, separated by commas: lavapipe, validation, colmap, ffmpeg, ...
const REQUIRE_VARIABLE: &str = "NIGHTSPLAT_REQUIRE";

/// Prints that a test, or the rest of it, is not run for lack of `need`, and why.
///
/// The harness captures the output of `println!` and `eprintln!` in a passing test, but not that of the handle of
/// standard error: this line is shown by every `cargo test`.
///
/// # Panics
/// `NIGHTSPLAT_REQUIRE` names `need`.
#[track_caller]
#[allow(clippy::explicit_write, reason = "`eprintln!` is what the harness swallows")]
pub fn not_run(need: &str, why: impl Display) {
    let (thread, location) = (std::thread::current(), Location::caller());
    let test = thread.name().unwrap_or("a test");
    // A closed standard error is no reason to fail.
    let _ = writeln!(std::io::stderr(), "not run: {test} ({location}): {need}: {why}");
    let required = std::env::var(REQUIRE_VARIABLE).unwrap_or_default();
    let is_required = required.split(',').any(|required| required.trim() == need);
    assert!(!is_required, "{REQUIRE_VARIABLE} names {need}");
}
