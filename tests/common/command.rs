//! The built binary as a shell runs it, and folders for its files.

use std::process::{Command, Output};

use serde_json::Value;

pub(crate) use super::{Folder, file_names, says};

/// `nightsplat` with arguments as a shell splits them; paths must not contain spaces. Any validation message fails it.
pub(crate) fn command(arguments: &str) -> Command {
    assert!(!arguments.contains('@'), "without the folder of its paths: {arguments}");
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

pub(crate) fn json(text: impl AsRef<[u8]>) -> Value {
    serde_json::from_slice(text.as_ref()).unwrap()
}

impl Folder {
    /// Arguments with the paths that they name.
    pub(crate) fn named(&self, arguments: &str) -> String {
        arguments.replace('@', &format!("{}/", self.display()))
    }

    pub(crate) fn command(&self, arguments: &str) -> Command {
        command(&self.named(arguments))
    }

    pub(crate) fn run(&self, arguments: &str, code: i32) -> (String, String) {
        run(&self.named(arguments), code)
    }

    pub(crate) fn succeed(&self, arguments: &str) -> String {
        succeed(&self.named(arguments))
    }

    pub(crate) fn refused(&self, arguments: &str, code: i32, parts: &[&str]) {
        refused(&self.named(arguments), code, parts);
    }

    /// [`refused`] for each line of a table: exit code | arguments | parts of the message, divided by `&`.
    pub(crate) fn refuses_all(&self, table: &str) {
        for row in table.lines().map(str::trim).filter(|row| !row.is_empty()) {
            let cells: Vec<&str> = row.split(" | ").map(str::trim).collect();
            let [code, arguments, parts] = cells[..] else { panic!("not a row: {row}") };
            self.refused(arguments, code.parse().unwrap(), &parts.split(" & ").collect::<Vec<_>>());
        }
    }

    pub(crate) fn json(&self, name: &str) -> Value {
        json(self.read(name))
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
