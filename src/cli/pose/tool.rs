//! The user's programs: how to get them, what they are called with, and what they said.

use std::ffi::OsStr;
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::Path;
use std::process::{Command, Stdio};

use crate::{Error, Result};

/// A program of the user's, whose output goes to a log.
pub(super) struct Tool<'a> {
    path: &'a Path,
    name: &'static str,
    log: &'a Path,
}

/// The last lines of a program that failed, in its message.
const LAST_LINES: usize = 3;

impl<'a> Tool<'a> {
    pub(super) fn new(path: &'a Path, name: &'static str, log: &'a Path) -> Self {
        Self { path, name, log }
    }

    /// Another whose output goes to the same log.
    pub(super) fn beside(&self, path: &'a Path, name: &'static str) -> Self {
        Self::new(path, name, self.log)
    }

    /// The tool, once it is there.
    ///
    /// # Errors
    /// [`Error::Usage`] says how to get it, and `besides`.
    pub(super) fn found(self, besides: &str) -> Result<Self> {
        let started = Command::new(self.path).arg("-h").stdin(Stdio::null()).output();
        let Err(error) = started else { return Ok(self) };
        let (path, name) = (self.path.display(), self.name);
        let problem = match error.kind() {
            ErrorKind::NotFound => format!("`{path}` is not found"),
            _ => format!("`{path}` does not run ({error})"),
        };
        let besides = if besides.is_empty() { String::new() } else { format!("; {besides}") };
        Err(Error::Usage(format!(
            "{problem}; install it ({}) or name it with --{name} PATH{besides}",
            sources(name)
        )))
    }

    /// Whether its help, of a command or of the whole, names something.
    pub(super) fn helps_with(&self, help: &[&str], what: &str) -> bool {
        let output = Command::new(self.path).args(help).stdin(Stdio::null()).output();
        output.is_ok_and(|output| {
            let text = [output.stdout, output.stderr].concat();
            String::from_utf8_lossy(&text).contains(what)
        })
    }

    /// Runs one of its commands to its end.
    ///
    /// # Errors
    /// [`Error::Input`] with its last lines where it fails.
    pub(super) fn run(&self, command: &str, arguments: &[&OsStr]) -> Result<()> {
        let cannot = |error: std::io::Error| {
            Error::output(
                self.log,
                format!("cannot be written ({error}); check the folder and the disk"),
            )
        };
        let mut log =
            OpenOptions::new().create(true).append(true).open(self.log).map_err(cannot)?;
        let shown: Vec<_> = arguments.iter().map(|argument| argument.to_string_lossy()).collect();
        let begin = log.metadata().map_err(cannot)?.len() as usize;
        writeln!(log, "$ {} {command} {}", self.path.display(), shown.join(" ")).map_err(cannot)?;
        let output = |log: &File| log.try_clone().map(Stdio::from).map_err(cannot);
        let mut process = Command::new(self.path);
        if !command.is_empty() {
            process.arg(command);
        }
        // Its windows need no display.
        process.args(arguments).env("QT_QPA_PLATFORM", "offscreen").stdin(Stdio::null());
        let status = process.stdout(output(&log)?).stderr(output(&log)?).status();
        let status =
            status.map_err(|error| Error::input(self.path, format!("does not run: {error}")))?;
        if status.success() {
            return Ok(());
        }
        let printed = std::fs::read(self.log).unwrap_or_default();
        let printed =
            String::from_utf8_lossy(printed.get(begin..).unwrap_or_default()).into_owned();
        let lines: Vec<&str> =
            printed.lines().skip(1).map(str::trim).filter(|line| !line.is_empty()).collect();
        let last = lines[lines.len().saturating_sub(LAST_LINES)..].join(" | ");
        let last = if last.is_empty() { "it said nothing".to_owned() } else { last };
        Err(Error::input(self.path, format!("{command} ended with {status}: {last}")))
    }

    /// Whether it said something, in any of its runs.
    pub(super) fn printed(&self, what: &str) -> bool {
        let printed = std::fs::read(self.log).unwrap_or_default();
        String::from_utf8_lossy(&printed).contains(what)
    }
}

/// Where a program comes from on each system.
fn sources(name: &str) -> &'static str {
    match name {
        "colmap" => {
            "Debian, Ubuntu: apt install colmap; Fedora: dnf install colmap; Arch: colmap of the AUR; macOS: brew install \
             colmap; Windows and others: https://github.com/colmap/colmap/releases"
        }
        "glomap" => {
            "https://github.com/colmap/glomap/releases, or COLMAP 4.0 and later, which has it"
        }
        _ => {
            "Debian, Ubuntu: apt install ffmpeg; Fedora: dnf install ffmpeg-free; Arch: pacman -S ffmpeg; macOS: brew \
             install ffmpeg; Windows: winget install ffmpeg; others: https://ffmpeg.org/download.html"
        }
    }
}
