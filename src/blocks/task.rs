//! The tasks of a plan, one JSON object on a line of `tasks.jsonl`: what schedulers read, and nothing else.

use std::path::Path;

use nightsplat_core::input;
use serde::{Deserialize, Serialize};

use crate::{Error, Result};

/// The file of the tasks.
pub(crate) const TASKS: &str = "tasks.jsonl";

/// A command of a plan.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Task {
    /// Its name, unique in the plan.
    pub(crate) id: String,
    /// The names of the tasks that must be done before.
    pub(crate) needs: Vec<String>,
    /// The command, to be run in the plan's folder: `nightsplat` and its arguments. Running it again continues or
    /// repeats it, to the same bytes.
    pub(crate) argv: Vec<String>,
    /// Memory that it may take, bytes.
    pub(crate) memory: u64,
    /// Disk that it may take, bytes.
    pub(crate) disk: u64,
    /// The number of devices that it needs.
    pub(crate) gpu: u32,
    /// The file that exists once it is done, relative to the plan's folder.
    pub(crate) done: String,
}

/// The tasks as lines.
pub(crate) fn lines(tasks: &[Task]) -> Result<String> {
    let line = |task| {
        let text = serde_json::to_string(task).map_err(|error| Error::Usage(error.to_string()))?;
        Ok(text + "\n")
    };
    tasks.iter().map(line).collect()
}

/// Reads the tasks of a plan; each comes after those that it needs.
pub(crate) fn load(folder: &Path) -> Result<Vec<Task>> {
    let path = folder.join(TASKS);
    if !path.is_file() {
        let problem = "contains no plan (tasks.jsonl); write one with `nightsplat blocks plan PHOTOS --out PLAN`";
        return Err(Error::input(folder, problem));
    }
    let mut tasks: Vec<Task> = vec![];
    for (number, line) in (1..).zip(input::text(&path)?.lines()) {
        let wrong =
            |problem: String| Error::input(&path, format!("line {number}: {problem}; plan anew"));
        let task: Task = serde_json::from_str(line).map_err(|error| wrong(error.to_string()))?;
        let is_known = |id: &String| tasks.iter().any(|task| task.id == *id);
        if let Some(need) = task.needs.iter().find(|need| !is_known(need)) {
            return Err(wrong(format!("task {} needs {need}, which does not precede it", task.id)));
        }
        tasks.push(task);
    }
    Ok(tasks)
}
