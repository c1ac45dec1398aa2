//! Trains the unfinished points, each in a separate process.
//!
//! The process holds a lock on the file `lock` of its run directory, inherited as standard input, until it ends. If a
//! sweep is killed, its processes may continue; the next sweep waits for them. Two sweeps in the same folder share
//! their points in the same way. A sweep that receives a signal passes it on, and waits for its processes to save.

use std::fs::{File, TryLockError};
use std::io::Write;
use std::path::Path;
use std::process::ExitStatus;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use indicatif::ProgressBar;
use nightsplat_core::output::own_file;

use super::run::SweepTraining;
use crate::cli::{child, signals, tell_on_stderr};
use crate::results::run::Requests;
use crate::results::sweep::FailedPoint;
use crate::{Error, Result, Stop};

/// Trains `runs`, `jobs` at once, and returns the failures in their order.
///
/// # Errors
/// [`Error::BatchStopped`] after a signal, or if the time of a run is up; `all` counts the runs of `folder`.
pub(super) fn train(
    runs: &[&SweepTraining],
    jobs: usize,
    bar: &ProgressBar,
    folder: &Path,
    all: usize,
) -> Result<Vec<FailedPoint>> {
    let requests = signals::requests()?;
    let time_up = AtomicBool::new(false);
    bar.enable_steady_tick(Duration::from_secs(1));
    let begin = Instant::now();
    let (next, busy, failures) = (AtomicUsize::new(0), Mutex::new(vec![]), Mutex::new(vec![]));
    let finish = |index: usize, waits: bool| {
        let run: &SweepTraining = runs[index];
        let failure = match attempt(run, waits, &requests) {
            Ok(RunState::Finished) => None,
            Ok(RunState::Busy) => return locked(&busy).push(index),
            Ok(RunState::Saved) => return time_up.store(true, Ordering::Relaxed),
            Err(error) => Some(error.to_string()),
        };
        bar.set_message(run.run.name.clone());
        bar.inc(1);
        if bar.is_hidden() {
            let (done, of) = (bar.position(), runs.len());
            let state = if failure.is_none() { "finished" } else { "failed" };
            let seconds = begin.elapsed().as_secs_f64();
            let line = format!("{done} of {of}: {} {state}, {seconds:.0} s", run.run.name);
            tell_on_stderr(line);
        }
        if let Some(reason) = failure {
            bar.suspend(|| tracing::warn!("{} failed: {reason}", run.run.name));
            locked(&failures).push((index, FailedPoint { name: run.run.name.clone(), reason }));
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
                // Points of other processes come last.
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

/// Locks a list, even if another thread panicked.
fn locked<T>(list: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    list.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// The state of a run.
enum RunState {
    Finished,
    /// Another process trains it.
    Busy,
    /// It stopped with a checkpoint.
    Saved,
}

/// Trains a run unless it is finished, or another process trains it and `waits` is false.
fn attempt(run: &SweepTraining, waits: bool, requests: &Requests) -> Result<RunState> {
    let unusable =
        |error: std::io::Error| Error::output(&run.run.folder, format!("cannot be used: {error}"));
    std::fs::create_dir_all(&run.run.folder).map_err(unusable)?;
    let lock = File::create(own_file(run.run.folder.join("lock"))?).map_err(unusable)?;
    match lock.try_lock() {
        Err(TryLockError::WouldBlock) if waits => lock.lock().map_err(unusable)?,
        Err(TryLockError::WouldBlock) => return Ok(RunState::Busy),
        // Without file locks, only one sweep at a time is safe.
        Err(TryLockError::Error(_)) | Ok(()) => {}
    }
    if run.is_finished()? {
        return Ok(RunState::Finished);
    }
    let log = own_file(run.run.folder.join("log.txt"))?;
    let mut output = File::create(&log).map_err(unusable)?;
    writeln!(output, "{}", run.command_line()?).map_err(unusable)?;
    let mut process = child::command()
        .map_err(unusable)?
        .args(&run.arguments)
        .stdin(lock.try_clone().map_err(unusable)?)
        .stdout(output.try_clone().map_err(unusable)?)
        .stderr(output)
        .spawn()
        .map_err(unusable)?;
    let status = child::ended(&mut process, requests).map_err(unusable)?;
    if status.success() && run.is_finished()? {
        return Ok(RunState::Finished);
    }
    if Stop::ALL.iter().any(|stop| status.code() == Some(stop.exit_code().into())) {
        return Ok(RunState::Saved);
    }
    let printed = std::fs::read(&log).unwrap_or_default();
    let reason = last_words(&String::from_utf8_lossy(&printed), status);
    Err(Error::output(&run.run.folder, format!("{reason}; see log.txt")))
}

/// The last error in a log, or else the exit status.
fn last_words(log: &str, status: ExitStatus) -> String {
    let error = log.lines().rev().find_map(|line| line.strip_prefix("error: "));
    error.map_or_else(|| status.to_string(), str::to_owned)
}
