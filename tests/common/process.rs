//! Commands that go on by themselves, are signalled, and end.
#![cfg(unix)]

use std::fmt::Display;
use std::io::{BufRead, BufReader};
use std::process::Child;

use super::prelude::*;

/// With its outputs in pipes.
pub(crate) fn spawned(command: &mut Command) -> Child {
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

/// A training that prints JSON, when it has started.
pub(crate) fn started(command: &mut Command) -> Child {
    let mut child = spawned(command);
    let mut line = String::new();
    BufReader::new(child.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    says(&line, &["started", "peak_device"]);
    child
}

pub(crate) fn send(signal: &str, process: impl Display) {
    let status = Command::new("kill").args([signal, &process.to_string()]).status();
    assert!(status.unwrap().success());
}

/// Exit code, standard output as far as it was not read, and standard error.
pub(crate) fn ended(child: Child) -> (i32, String, String) {
    let output = child.wait_with_output().unwrap();
    let [stdout, stderr] =
        [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    (output.status.code().unwrap_or(-1), stdout, stderr)
}

/// The process must end with this exit code, and all these parts on standard error.
#[track_caller]
pub(crate) fn ends(child: Child, code: i32, parts: &[&str]) -> String {
    let (found, _, stderr) = ended(child);
    assert_eq!(found, code, "{stderr}");
    says(&stderr, parts);
    stderr
}

/// Until there is a file, and something in it.
#[track_caller]
pub(crate) fn wait_for(path: &Path) {
    let there = || fs::metadata(path).is_ok_and(|file| file.len() > 0);
    wait_until(&format!("{} comes", path.display()), there);
}

#[track_caller]
pub(crate) fn wait_until(what: &str, so: impl Fn() -> bool) {
    let begin = Instant::now();
    while !so() {
        assert!(begin.elapsed() < Duration::from_secs(120), "waited in vain until {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}
