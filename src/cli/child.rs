//! Processes of this program that a command starts and waits for.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus};
use std::time::Duration;

use crate::results::run::Requests;

/// A process of this program, to be waited for by [`ended`]. Signals of the terminal reach the waiting process only,
/// which passes them on once.
pub(super) fn command() -> std::io::Result<Command> {
    #[cfg_attr(not(unix), expect(unused_mut, reason = "groups are of Unix"))]
    let mut command = Command::new(this_program()?);
    #[cfg(unix)]
    {
        use std::os::unix::process::CommandExt;
        command.process_group(0).arg0("nightsplat");
    }
    Ok(command)
}

/// This program; on Linux the running one, even if its file was replaced, so that all processes are of one version.
fn this_program() -> std::io::Result<PathBuf> {
    let running = Path::new("/proc/self/exe");
    if running.exists() { Ok(running.to_owned()) } else { std::env::current_exe() }
}

/// Waits for a process, passing on a request to stop.
pub(super) fn ended(child: &mut Child, requests: &Requests) -> std::io::Result<ExitStatus> {
    const POLL: Duration = Duration::from_millis(50);
    let mut is_told = false;
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(status);
        }
        if requests.stops().is_some() && !std::mem::replace(&mut is_told, true) {
            // The standard library cannot send SIGTERM.
            let kill = format!("kill -TERM {}", child.id());
            Command::new("sh").args(["-c", &kill]).status()?;
        }
        std::thread::sleep(POLL);
    }
}
