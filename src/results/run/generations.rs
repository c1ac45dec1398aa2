//! The two checkpoints of a run: the newest, and the one before for where that is damaged.

use std::path::{Path, PathBuf};

use super::files::{CHECKPOINT, CHECKPOINT_BEFORE, unwritable};
use crate::Result;
use crate::train::check_checkpoint;

fn both(run: &Path) -> [PathBuf; 2] {
    [CHECKPOINT, CHECKPOINT_BEFORE].map(|file| run.join(file))
}

/// The checkpoint that a run goes on from: the newest that is whole, else the newest, to say what is wrong with it; none
/// where there is none.
pub(super) fn newest(run: &Path) -> Option<PathBuf> {
    let [newest, before] = both(run);
    let problem = match newest.is_file().then(|| check_checkpoint(&newest)) {
        Some(Ok(())) => return Some(newest),
        Some(Err(problem)) => Some(problem),
        None => None,
    };
    if before.is_file() && check_checkpoint(&before).is_ok() {
        if let Some(problem) = problem {
            tracing::warn!("{problem}: the run goes on from the checkpoint before");
        }
        return Some(before);
    }
    [newest, before].into_iter().find(|path| path.is_file())
}

/// Removes a newest checkpoint that is damaged, once the run goes on from the one before: it would take that one's place.
pub(super) fn keep_whole(run: &Path) -> Result<()> {
    let [newest, _] = both(run);
    if newest.is_file() && check_checkpoint(&newest).is_err() {
        std::fs::remove_file(&newest).map_err(|error| unwritable(&newest, &error))?;
    }
    Ok(())
}

/// Where the next one is to be written: the newest becomes the one before, and stays if that fails.
pub(super) fn rotate(run: &Path) -> Result<PathBuf> {
    let [newest, before] = both(run);
    if newest.exists() {
        std::fs::rename(&newest, before).map_err(|error| unwritable(&newest, &error))?;
    }
    Ok(newest)
}
