//! Trains the points that are left, each in a process of its own.
//!
//! That process holds a lock on the file `lock` of its run directory, inherited as its standard input, until it ends:
//! a sweep that is killed may leave a process at work, and the next one waits for it instead of writing beside it. Two
//! sweeps in one folder share its points in the same way. A sweep that is asked to stop asks its processes, and waits
//! until they have saved.

use std::fs::{File, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use indicatif::ProgressBar;

use super::run::Run;
use crate::cli::signals;
use crate::results::run::Requests;
use crate::{Error, Result, Stop};

/// A point that did not finish, and why.
#[derive(Clone, Debug)]
pub(super) struct Failure {
    /// The point's name.
    pub(super) name: String,
    /// What its process said last.
    pub(super) reason: String,
}

/// Trains every run that is not finished, `jobs` at once; what failed, in the order of `runs`.
///
/// # Errors
/// [`Error::BatchStopped`] where that was asked for, or the time of a run was up: `all` runs are to be in `folder`.
pub(super) fn train(
    runs: &[&Run],
    jobs: usize,
    bar: &ProgressBar,
    (folder, all): (&Path, usize),
) -> Result<Vec<Failure>> {
    let requests = signals::requests()?;
    let time_up = AtomicBool::new(false);
    bar.enable_steady_tick(Duration::from_secs(1));
    let (next, busy, failures) = (AtomicUsize::new(0), Mutex::new(vec![]), Mutex::new(vec![]));
    let finish = |index: usize, waits: bool| {
        let run: &Run = runs[index];
        let failure = match attempt(run, waits, &requests) {
            Ok(Outcome::Finished) => None,
            Ok(Outcome::Busy) => return locked(&busy).push(index),
            Ok(Outcome::Saved) => return time_up.store(true, Ordering::Relaxed),
            Err(error) => Some(error.to_string()),
        };
        bar.set_message(run.name.clone());
        bar.inc(1);
        match failure {
            None => bar.suspend(|| tracing::info!("{}: finished", run.name)),
            Some(reason) => {
                bar.suspend(|| tracing::warn!("{} failed: {reason}", run.name));
                locked(&failures).push((index, Failure { name: run.name.clone(), reason }));
            }
        }
    };
    std::thread::scope(|scope| {
        for _ in 0..jobs.clamp(1, runs.len().max(1)) {
            scope.spawn(|| {
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    if index >= runs.len() || requests.stops().is_some() {
                        break;
                    }
                    finish(index, false);
                }
                // What other processes are at comes last.
                loop {
                    let index = locked(&busy).pop();
                    let Some(index) = index.filter(|_| requests.stops().is_none()) else { break };
                    finish(index, true);
                }
            });
        }
    });
    bar.finish_and_clear();
    if let Some(cause) = requests.stops().or(time_up.into_inner().then_some(Stop::TimeUp)) {
        let left = runs.iter().filter(|run| !matches!(run.is_finished(), Ok(true))).count();
        let (folder, done) = (folder.to_owned(), all.saturating_sub(left));
        return Err(Error::BatchStopped { folder, done, all, cause });
    }
    let mut failures = std::mem::take(&mut *locked(&failures));
    failures.sort_by_key(|(index, _)| *index);
    Ok(failures.into_iter().map(|(_, failure)| failure).collect())
}

/// A list that stays usable where another thread panicked.
fn locked<T>(list: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    list.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// How a run stands.
enum Outcome {
    Finished,
    /// Another process is at it.
    Busy,
    /// It can go on from what it saved.
    Saved,
}

/// Trains a run unless it is finished, or another process is at it and `waits` is false.
fn attempt(run: &Run, waits: bool, requests: &Requests) -> Result<Outcome> {
    let unusable =
        |error: std::io::Error| Error::output(&run.folder, format!("cannot be used: {error}"));
    std::fs::create_dir_all(&run.folder).map_err(unusable)?;
    let lock = File::create(run.folder.join("lock")).map_err(unusable)?;
    match lock.try_lock() {
        Err(TryLockError::WouldBlock) if waits => lock.lock().map_err(unusable)?,
        Err(TryLockError::WouldBlock) => return Ok(Outcome::Busy),
        // A file system without locks: one sweep at a time is all that it can have.
        Err(TryLockError::Error(_)) | Ok(()) => {}
    }
    if run.is_finished()? {
        return Ok(Outcome::Finished);
    }
    let log = run.folder.join("log.txt");
    let mut output = File::create(&log).map_err(unusable)?;
    writeln!(output, "{}", run.command_line()?).map_err(unusable)?;
    let mut command = Command::new(this_program().map_err(unusable)?);
    command
        .args(&run.arguments)
        .stdin(lock.try_clone().map_err(unusable)?)
        .stdout(output.try_clone().map_err(unusable)?)
        .stderr(output);
    // A signal of the terminal is for us: what it asks of a process is asked once.
    #[cfg(unix)]
    {
        use std::os::unix::process::CommandExt;
        command.process_group(0).arg0("nightsplat");
    }
    let mut child = command.spawn().map_err(unusable)?;
    let status = ended(&mut child, requests).map_err(unusable)?;
    if status.success() && run.is_finished()? {
        return Ok(Outcome::Finished);
    }
    let stops = [Stop::Interrupted, Stop::Terminated, Stop::TimeUp];
    if stops.iter().any(|stop| status.code() == Some(stop.exit_code().into())) {
        return Ok(Outcome::Saved);
    }
    let printed = std::fs::read(&log).unwrap_or_default();
    let reason = last_words(&String::from_utf8_lossy(&printed), status);
    Err(Error::output(&run.folder, format!("{reason}; log.txt says more")))
}

/// This program; on Linux as it runs, even where another version has taken its file's place: all points are trained by one.
fn this_program() -> std::io::Result<PathBuf> {
    let running = Path::new("/proc/self/exe");
    if running.exists() { Ok(running.to_owned()) } else { std::env::current_exe() }
}

/// Waits for a process, which is asked to save and stop once we are.
fn ended(child: &mut Child, requests: &Requests) -> std::io::Result<ExitStatus> {
    const POLL: Duration = Duration::from_millis(50);
    let mut is_told = false;
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(status);
        }
        if requests.stops().is_some() && !std::mem::replace(&mut is_told, true) {
            // The standard library only knows how to kill.
            let kill = format!("kill -TERM {}", child.id());
            Command::new("sh").args(["-c", &kill]).status()?;
        }
        std::thread::sleep(POLL);
    }
}

/// The last error of a log; where it has none, how the process ended.
fn last_words(log: &str, status: ExitStatus) -> String {
    let error = log.lines().rev().find_map(|line| line.strip_prefix("error: "));
    error.map_or_else(|| status.to_string(), str::to_owned)
}
