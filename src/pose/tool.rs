//! Runs external programs and logs their output.

use std::ffi::OsStr;
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use crate::{Error, Result};

/// An external program whose output goes to a log.
pub(super) struct Tool<'a> {
    path: &'a Path,
    name: &'static str,
    log: &'a Path,
}

/// Lines of a failed program's output that its error quotes.
const QUOTED_LINES: usize = 3;

impl<'a> Tool<'a> {
    pub(super) fn new(path: &'a Path, name: &'static str, log: &'a Path) -> Self {
        Self { path, name, log }
    }

    /// Another program with the same log.
    pub(super) fn with_same_log(&self, path: &'a Path, name: &'static str) -> Self {
        Self::new(path, name, self.log)
    }

    /// Checks that the program runs.
    pub(super) fn found(self, alternative: &str) -> Result<Self> {
        let started = Command::new(self.path).arg("-h").stdin(Stdio::null()).output();
        let Err(error) = started else { return Ok(self) };
        let (path, name) = (self.path.display(), self.name);
        let problem = match error.kind() {
            ErrorKind::NotFound => format!("`{path}` is not found"),
            _ => format!("`{path}` does not run ({error})"),
        };
        let alternative =
            if alternative.is_empty() { String::new() } else { format!("; {alternative}") };
        Err(Error::Usage(format!(
            "{problem}; install it ({}) or name it with --{name} PATH{alternative}",
            how_to_install(name)
        )))
    }

    /// Whether the output for the arguments `help` contains `what`.
    pub(super) fn help_contains(&self, help: &[&str], what: &str) -> bool {
        let output = Command::new(self.path).args(help).stdin(Stdio::null()).output();
        output.is_ok_and(|output| {
            let text = [output.stdout, output.stderr].concat();
            String::from_utf8_lossy(&text).contains(what)
        })
    }

    /// Whether the help of a command lists an option.
    pub(super) fn has_option(&self, command: &str, option: &str) -> bool {
        self.help_contains(&[command, "-h"], &format!("--{option} "))
    }

    /// An entry of the first video stream of a clip, by the ffprobe next to this ffmpeg; `None` if it fails.
    pub(super) fn probe(&self, clip: &Path, entry: &str) -> Option<String> {
        let name = self.path.file_name()?.to_str()?.replace("ffmpeg", "ffprobe");
        let arguments =
            ["-v", "error", "-select_streams", "v:0", "-of", "default=nokey=1:noprint_wrappers=1"];
        let mut process = Command::new(self.path.with_file_name(name));
        // A name that begins with a dash is not an option.
        let clip = Path::new(".").join(clip);
        process.args(arguments).arg("-show_entries").arg(format!("stream={entry}")).arg(clip);
        let output = process.stdin(Stdio::null()).output().ok()?;
        let text = String::from_utf8(output.stdout).ok()?;
        output.status.success().then(|| text.lines().next().unwrap_or_default().to_owned())
    }

    /// Runs one of its commands to completion, and passes the output so far to `watch`, twice a second.
    pub(super) fn run(
        &self,
        command: &str,
        arguments: &[&OsStr],
        mut watch: impl FnMut(&str),
    ) -> Result<()> {
        let cannot = |error: std::io::Error| {
            let problem = format!("cannot be written ({error}); check the folder and the disk");
            Error::output(self.log, problem)
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
        // COLMAP without a display.
        process.args(arguments).env("QT_QPA_PLATFORM", "offscreen").stdin(Stdio::null());
        let unrunnable = |error| Error::input(self.path, format!("does not run: {error}"));
        let started = process.stdout(output(&log)?).stderr(output(&log)?).spawn();
        let mut child = started.map_err(unrunnable)?;
        let printed = || {
            let printed = std::fs::read(self.log).unwrap_or_default();
            String::from_utf8_lossy(printed.get(begin..).unwrap_or_default()).into_owned()
        };
        let mut pause = Duration::from_millis(5);
        let status = loop {
            if let Some(status) = child.try_wait().map_err(unrunnable)? {
                break status;
            }
            std::thread::sleep(pause);
            pause = (2 * pause).min(Duration::from_millis(500));
            watch(&printed());
        };
        if status.success() {
            return Ok(());
        }
        let printed = printed();
        let quoted = quoted(printed.lines().skip(1));
        Err(Error::input(self.path, format!("{command} ended with {status}: {quoted}")))
    }

    /// Whether the log contains `what`.
    pub(super) fn printed(&self, what: &str) -> bool {
        let printed = std::fs::read(self.log).unwrap_or_default();
        String::from_utf8_lossy(&printed).contains(what)
    }
}

/// What a failed program's error quotes of its lines: from the first error on, or the last.
fn quoted<'a>(lines: impl Iterator<Item = &'a str>) -> String {
    const ERRORS: [&str; 6] = ["error", "fail", "cannot", "could not", "invalid", "no such"];
    let lines: Vec<&str> = lines.map(str::trim).filter(|line| !line.is_empty()).collect();
    let is_error = |line: &&str| {
        let line = line.to_lowercase();
        ERRORS.iter().any(|word| line.contains(word))
    };
    let last = lines.len().saturating_sub(QUOTED_LINES);
    let first = lines.iter().position(is_error).unwrap_or(last);
    match lines[first..].iter().take(QUOTED_LINES).copied().collect::<Vec<_>>().join(" | ") {
        quoted if quoted.is_empty() => "no output".to_owned(),
        quoted => quoted,
    }
}

/// How to install a program on each system.
pub fn how_to_install(name: &str) -> &'static str {
    match name {
        "colmap" => {
            "Debian, Ubuntu: apt install colmap; Fedora: dnf install colmap; Arch: colmap of the AUR; macOS: \
             brew install colmap; Windows and others: https://github.com/colmap/colmap/releases"
        }
        "glomap" => {
            "https://github.com/colmap/glomap/releases, or COLMAP 4.0 and later, which has it"
        }
        _ => {
            "Debian, Ubuntu: apt install ffmpeg; Fedora: dnf install ffmpeg-free; Arch: pacman -S ffmpeg; \
             macOS: brew install ffmpeg; Windows: winget install ffmpeg; others: https://ffmpeg.org/download.html"
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_error_of_a_program_is_quoted() {
        let lines =
            ["Input #0", "Could not open file", "muxing", "", "4 frames", "Conversion failed!"];
        assert_eq!(quoted(lines.into_iter()), "Could not open file | muxing | 4 frames");
        assert_eq!(quoted(["1", "2", "3", "4"].into_iter()), "2 | 3 | 4");
        assert_eq!(quoted([""].into_iter()), "no output");
    }
}
