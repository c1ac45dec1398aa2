//! Runs external programs, logs their output, and stops them.

use std::ffi::OsStr;
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use super::unfinished::Unfinished;
use nightsplat_core::{Error, Result, Stop};

/// An external program that works in an unfinished dataset. It holds the lock of that as long as it runs, so that none
/// that outlives this process writes into what another process uses.
#[derive(Clone, Copy)]
pub(super) struct Tool<'a> {
    path: &'a Path,
    name: &'static str,
    out: &'a Unfinished,
    /// The request to stop, if there is one.
    stops: &'a dyn Fn() -> Option<Stop>,
}

/// Lines of a failed program's output that its error quotes.
const QUOTED_LINES: usize = 3;

impl<'a> Tool<'a> {
    pub(super) fn new(
        path: &'a Path,
        name: &'static str,
        out: &'a Unfinished,
        stops: &'a dyn Fn() -> Option<Stop>,
    ) -> Self {
        Self { path, name, out, stops }
    }

    /// Another program for the same dataset.
    pub(super) fn beside(&self, path: &'a Path, name: &'static str) -> Self {
        Self { path, name, ..*self }
    }

    /// Checks that the program runs.
    pub(super) fn found(self) -> Result<Self> {
        let started = Command::new(self.path).arg("-h").stdin(Stdio::null()).output();
        let Err(error) = started else { return Ok(self) };
        let (path, name) = (self.path.display(), self.name);
        let problem = match error.kind() {
            ErrorKind::NotFound => format!("`{path}` is not found"),
            _ => format!("`{path}` does not run ({error})"),
        };
        Err(Error::Usage(format!(
            "{problem}; install it ({}) or name it with --{name} PATH",
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

    /// Runs one of its commands to completion, and passes the output so far to `watch`, twice a second. False: the time
    /// was up before.
    ///
    /// # Errors
    /// It fails, or is stopped on request.
    pub(super) fn run(
        &self,
        command: &str,
        arguments: &[&OsStr],
        until: Option<Instant>,
        mut watch: impl FnMut(&str),
    ) -> Result<bool> {
        let path = self.out.log.as_path();
        let cannot = |error: std::io::Error| {
            let problem = format!("cannot be written ({error}); check the folder and the disk");
            Error::output(path, problem)
        };
        let mut log = OpenOptions::new().create(true).append(true).open(path).map_err(cannot)?;
        let shown: Vec<_> = arguments.iter().map(|argument| argument.to_string_lossy()).collect();
        let begin = log.metadata().map_err(cannot)?.len() as usize;
        writeln!(log, "$ {} {command} {}", self.path.display(), shown.join(" ")).map_err(cannot)?;
        let output = |log: &File| log.try_clone().map(Stdio::from).map_err(cannot);
        let mut process = Command::new(self.path);
        if !command.is_empty() {
            process.arg(command);
        }
        // COLMAP without a display. Signals of the terminal are for this process, which passes them on.
        process.args(arguments).env("QT_QPA_PLATFORM", "offscreen");
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut process, 0);
        let unrunnable = |error| Error::input(self.path, format!("does not run: {error}"));
        process.stdin(self.out.lock.shared().map_err(cannot)?);
        let started = process.stdout(output(&log)?).stderr(output(&log)?).spawn();
        let mut child = started.map_err(unrunnable)?;
        self.out.lock.name(child.id());
        let printed = || {
            let printed = std::fs::read(path).unwrap_or_default();
            String::from_utf8_lossy(printed.get(begin..).unwrap_or_default()).into_owned()
        };
        let mut pause = Duration::from_millis(5);
        let status = loop {
            if let Some(status) = child.try_wait().map_err(unrunnable)? {
                break status;
            }
            if let Some(cause) = (self.stops)() {
                end(&mut child).map_err(unrunnable)?;
                let stage = if command.is_empty() { self.name } else { command };
                return Err(self.out.stopped(stage, cause));
            }
            if until.is_some_and(|until| until <= Instant::now()) {
                end(&mut child).map_err(unrunnable)?;
                return Ok(false);
            }
            std::thread::sleep(pause);
            pause = (2 * pause).min(Duration::from_millis(500));
            watch(&printed());
        };
        if status.success() {
            return Ok(true);
        }
        let printed = printed();
        let quoted = quoted(printed.lines().skip(1));
        Err(Error::input(self.path, format!("{command} ended with {status}: {quoted}")))
    }

    /// Whether the log contains `what`.
    pub(super) fn printed(&self, what: &str) -> bool {
        let printed = std::fs::read(&self.out.log).unwrap_or_default();
        String::from_utf8_lossy(&printed).contains(what)
    }
}

/// Ends a process, whose database survives that.
fn end(child: &mut Child) -> std::io::Result<()> {
    child.kill()?;
    child.wait().map(drop)
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
            "apt install colmap, dnf install colmap, brew install colmap, or https://github.com/colmap/colmap/releases"
        }
        "glomap" => {
            "https://github.com/colmap/glomap/releases, or COLMAP 4.0 and later, which has it"
        }
        _ => {
            "apt install ffmpeg, dnf install ffmpeg-free, brew install ffmpeg, winget install ffmpeg, or \
             https://ffmpeg.org/download.html"
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
