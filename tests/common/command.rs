//! The built binary as a shell runs it.

use std::process::{Command, Output};

/// `nightsplat` with arguments as a shell splits them; paths must not contain spaces. Any validation message fails it.
pub(crate) fn command(arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_nightsplat"));
    // Tests train with the built-in tiles, not those measured on this machine.
    let environment = [("NIGHTSPLAT_FAIL_ON_VALIDATION", "1"), ("NIGHTSPLAT_TUNE", "off")];
    command.args(arguments.split_whitespace()).envs(environment);
    command
}

/// Standard output and error of a command that must end with this exit code.
pub(crate) fn run(arguments: &str, code: i32) -> (String, String) {
    outcome(arguments, command(arguments).output().unwrap(), code)
}

fn outcome(arguments: &str, output: Output, code: i32) -> (String, String) {
    let [stdout, stderr] =
        [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    assert_eq!(output.status.code(), Some(code), "{arguments}: {stderr}");
    (stdout, stderr)
}

/// Standard output of a command that must succeed.
pub(crate) fn succeed(arguments: &str) -> String {
    run(arguments, 0).0
}

/// The command must fail with this exit code and one line on standard error that contains all of `parts`.
pub(crate) fn refused(arguments: &str, code: i32, parts: &[&str]) {
    refused_with(arguments, &[], code, parts);
}

/// [`refused`] with environment variables.
pub(crate) fn refused_with(
    arguments: &str,
    environment: &[(&str, &str)],
    code: i32,
    parts: &[&str],
) {
    let output = command(arguments).envs(environment.iter().copied()).output().unwrap();
    let (_, stderr) = outcome(arguments, output, code);
    let mut lines = stderr.lines();
    let line = lines.next().unwrap_or_default();
    assert!(line.starts_with("error: ") && lines.next().is_none(), "{arguments}: {stderr}");
    for part in parts {
        assert!(line.contains(part), "{arguments}: no `{part}` in: {line}");
    }
}

/// A text without the line breaks of its paragraphs.
pub(crate) fn unwrapped(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Whether a program is on the path.
pub(crate) fn exists(program: &str) -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|folder| folder.join(program).is_file())
}
