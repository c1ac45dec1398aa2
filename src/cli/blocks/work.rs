//! Runs the tasks of a plan one after another, each in a process of its own.

use std::path::Path;
use std::process::ExitStatus;

use crate::blocks::{Task, load_tasks};
use crate::cli::{child, signals};
use crate::results::run::Requests;
use crate::{Error, Result, Stop};

/// Runs the tasks of the plan in a folder that are not done, in order; `begin` is called before each, with its number,
/// the number of all, and whether it is done already. A signal is passed on, and no further task begins.
pub(super) fn work(folder: &Path, mut begin: impl FnMut(&Task, [usize; 2], bool)) -> Result<()> {
    let tasks = load_tasks(folder)?;
    let requests = signals::requests()?;
    for (number, task) in (1..).zip(&tasks) {
        let is_done = folder.join(&task.done).is_file();
        begin(task, [number, tasks.len()], is_done);
        if is_done {
            continue;
        }
        let status = run(folder, task, &requests).map_err(|error| {
            Error::input(folder, format!("task {} cannot be started: {error}", task.id))
        })?;
        let stopped =
            Stop::ALL.into_iter().find(|stop| status.code() == Some(stop.exit_code().into()));
        // The signal that came is the cause, not that by which it was passed on.
        if let Some(cause) = requests.stops().or(stopped) {
            let (folder, done) = (folder.to_owned(), number - 1);
            return Err(Error::BatchStopped { folder, done, all: tasks.len(), cause });
        }
        if !status.success() {
            let problem = format!("task {} {}; run this again to continue", task.id, end(status));
            return Err(Error::input(folder, problem));
        }
    }
    Ok(())
}

fn run(folder: &Path, task: &Task, requests: &Requests) -> std::io::Result<ExitStatus> {
    let mut process =
        child::command()?.args(task.argv.iter().skip(1)).current_dir(folder).spawn()?;
    child::ended(&mut process, requests)
}

/// How a process ended, in words.
fn end(status: ExitStatus) -> String {
    match status.code() {
        Some(code) => format!("failed with exit code {code}, for the reason above"),
        None => format!("ended by {status}"),
    }
}
