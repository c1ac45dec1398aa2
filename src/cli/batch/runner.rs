//! Trains the points that are left, each in a process of its own.
//!
//! That process holds a lock on the file `lock` of its run directory, inherited as its standard input, until it ends:
//! a batch that is killed may leave a process at work, and the next one waits for it instead of writing beside it. Two
//! batches in one folder share its points in the same way.

use std::fs::{File, TryLockError};
use std::io::Write;
use std::process::{Command, ExitStatus};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use indicatif::ProgressBar;

use super::Run;
use crate::{Error, Result};

/// A point that did not finish, and why.
#[derive(Clone, Debug)]
pub(in crate::cli) struct Failure {
    /// The point's name.
    pub(in crate::cli) name: String,
    /// What its process said last.
    pub(in crate::cli) reason: String,
}

/// Trains every run that is not finished, `jobs` at once; what failed, in the order of `runs`.
pub(in crate::cli) fn train(runs: &[&Run], jobs: usize, bar: &ProgressBar) -> Vec<Failure> {
    bar.enable_steady_tick(Duration::from_secs(1));
    let (next, busy, failures) = (AtomicUsize::new(0), Mutex::new(vec![]), Mutex::new(vec![]));
    let finish = |index: usize, waits: bool| {
        let run: &Run = runs[index];
        let failure = match attempt(run, waits) {
            Ok(true) => None,
            Ok(false) => return locked(&busy).push(index),
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
                    if index >= runs.len() {
                        break;
                    }
                    finish(index, false);
                }
                // What other processes are at comes last.
                loop {
                    let index = locked(&busy).pop();
                    let Some(index) = index else { break };
                    finish(index, true);
                }
            });
        }
    });
    bar.finish_and_clear();
    let mut failures = std::mem::take(&mut *locked(&failures));
    failures.sort_by_key(|(index, _)| *index);
    failures.into_iter().map(|(_, failure)| failure).collect()
}

/// A list that stays usable where another thread panicked.
fn locked<T>(list: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    list.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// Trains a run unless it is finished; false where another process is at it and `waits` is false.
fn attempt(run: &Run, waits: bool) -> Result<bool> {
    let unusable =
        |error: std::io::Error| Error::output(&run.folder, format!("cannot be used: {error}"));
    std::fs::create_dir_all(&run.folder).map_err(unusable)?;
    let lock = File::create(run.folder.join("lock")).map_err(unusable)?;
    match lock.try_lock() {
        Err(TryLockError::WouldBlock) if waits => lock.lock().map_err(unusable)?,
        Err(TryLockError::WouldBlock) => return Ok(false),
        // A file system without locks: one batch at a time is all that it can have.
        Err(TryLockError::Error(_)) | Ok(()) => {}
    }
    if run.is_finished()? {
        return Ok(true);
    }
    let log = run.folder.join("log.txt");
    let mut output = File::create(&log).map_err(unusable)?;
    writeln!(output, "{}", run.command_line()?).map_err(unusable)?;
    let status = Command::new(std::env::current_exe().map_err(unusable)?)
        .args(&run.arguments)
        .stdin(lock.try_clone().map_err(unusable)?)
        .stdout(output.try_clone().map_err(unusable)?)
        .stderr(output)
        .status()
        .map_err(unusable)?;
    if status.success() && run.is_finished()? {
        return Ok(true);
    }
    let said = std::fs::read(&log).unwrap_or_default();
    let reason = last_words(&String::from_utf8_lossy(&said), status);
    Err(Error::output(&run.folder, format!("{reason}; log.txt says more")))
}

/// The last error of a log; where it has none, how the process ended.
fn last_words(log: &str, status: ExitStatus) -> String {
    let error = log.lines().rev().find_map(|line| line.strip_prefix("error: "));
    error.map_or_else(|| status.to_string(), str::to_owned)
}
