//! The two checkpoints of a run: the newest, and the previous one in case the newest is damaged.

use std::path::{Path, PathBuf};

use nightsplat_core::output::own_file;

use super::files::{CHECKPOINT, CHECKPOINT_BEFORE, unwritable};
use crate::Result;
use crate::train::check_checkpoint;

fn both(run: &Path) -> [PathBuf; 2] {
    [CHECKPOINT, CHECKPOINT_BEFORE].map(|file| run.join(file))
}

/// Whether there is a checkpoint.
pub fn has_checkpoint(run: &Path) -> bool {
    both(run).iter().any(|path| path.is_file())
}

/// The checkpoint to resume from: the newest that is intact, else the newest, so that its problem is reported; `None`
/// if there is none.
pub(super) fn newest(run: &Path) -> Option<PathBuf> {
    let [newest, before] = both(run);
    let problem = match newest.is_file().then(|| check_checkpoint(&newest)) {
        Some(Ok(())) => return Some(newest),
        Some(Err(problem)) => Some(problem),
        None => None,
    };
    if before.is_file() && check_checkpoint(&before).is_ok() {
        if let Some(problem) = problem {
            tracing::warn!("{problem}: resuming from the previous checkpoint");
        }
        return Some(before);
    }
    [newest, before].into_iter().find(|path| path.is_file())
}

/// Removes a damaged newest checkpoint, once the run has resumed from the previous one, which it would replace.
pub(super) fn keep_whole(run: &Path) -> Result<()> {
    let [newest, _] = both(run);
    if newest.is_file() && check_checkpoint(&newest).is_err() {
        std::fs::remove_file(&newest).map_err(|error| unwritable(&newest, &error))?;
    }
    Ok(())
}

/// The path of the next checkpoint. The newest becomes the previous one, and stays if writing fails.
pub(super) fn rotate(run: &Path) -> Result<PathBuf> {
    let [newest, before] = both(run);
    if newest.exists() {
        std::fs::rename(&newest, before).map_err(|error| unwritable(&newest, &error))?;
    }
    own_file(newest)
}
