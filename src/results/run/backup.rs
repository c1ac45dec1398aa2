//! The previous contents of a run directory: kept until the new run has done a step. Also recovers from a killed
//! process.

use std::path::{Path, PathBuf};

use super::files::{FILES, unwritable};
use crate::Result;

/// The folder of the files of a run that is being replaced.
const BACKUP: &str = ".replaced";

/// The files of the previous run. Dropping it restores them; [`Backup::give_up`] deletes them.
#[derive(Debug, Default)]
pub(super) struct Backup(Option<PathBuf>);

impl Backup {
    /// Moves the files of the run into the backup.
    pub(super) fn set(run: &Path) -> Result<Self> {
        let backup = run.join(BACKUP);
        let held: Vec<&str> = FILES.into_iter().filter(|file| run.join(file).exists()).collect();
        if held.is_empty() {
            return Ok(Self(None));
        }
        let failed = |error| unwritable(run, &error);
        std::fs::create_dir_all(&backup).map_err(failed)?;
        let guard = Self(Some(run.to_owned()));
        for file in held {
            std::fs::rename(run.join(file), backup.join(file)).map_err(failed)?;
        }
        Ok(guard)
    }

    /// Deletes the previous run, once the new one has begun.
    pub(super) fn give_up(&mut self) -> Result<()> {
        let Some(run) = self.0.take() else { return Ok(()) };
        std::fs::remove_dir_all(run.join(BACKUP)).map_err(|error| unwritable(&run, &error))
    }
}

impl Drop for Backup {
    fn drop(&mut self) {
        if let Some(run) = self.0.take() {
            // The earlier failure is the one to report; the next start tries again.
            let _ = restore(&run);
        }
    }
}

/// Cleans up after a killed process: restores a run that was being replaced and deletes partial files. The caller must
/// hold the lock.
pub(super) fn recover(run: &Path) -> Result<()> {
    restore(run).map_err(|error| unwritable(run, &error))?;
    for entry in std::fs::read_dir(run).map_err(|error| unwritable(run, &error))?.flatten() {
        if entry.file_name().to_str().is_some_and(is_half_written) {
            std::fs::remove_file(entry.path()).map_err(|error| unwritable(run, &error))?;
        }
    }
    Ok(())
}

/// Moves the backup back, over files that have begun in its place.
fn restore(run: &Path) -> std::io::Result<()> {
    let backup = run.join(BACKUP);
    if backup.is_symlink() {
        // What it leads to is no backup of ours.
        return std::fs::remove_file(backup);
    }
    if !backup.is_dir() {
        return Ok(());
    }
    for file in FILES {
        let (kept, begun) = (backup.join(file), run.join(file));
        if kept.exists() {
            std::fs::rename(kept, begun)?;
        } else if backup.join("config.toml").exists() && begun.exists() {
            std::fs::remove_file(begun)?;
        }
    }
    std::fs::remove_dir(backup)
}

/// Whether a file of this name is left by a killed process: a partial file of a run, or the temporary file of
/// safetensors.
fn is_half_written(name: &str) -> bool {
    let of_run = name.strip_suffix(".partial").is_some_and(|file| FILES.contains(&file));
    let drawn = name.strip_prefix(".tmp");
    of_run
        || drawn.is_some_and(|drawn| {
            drawn.len() == 6 && drawn.bytes().all(|b| b.is_ascii_alphanumeric())
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn content(run: &Path) -> Vec<(String, String)> {
        let mut content: Vec<_> = std::fs::read_dir(run)
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .map(|path| {
                let name = path.file_name().unwrap().to_str().unwrap().to_owned();
                (name, std::fs::read_to_string(path).unwrap_or_default())
            })
            .collect();
        content.sort();
        content
    }

    /// A finished run with a file of the user's.
    fn run() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for name in ["config.toml", "model.ply", "metrics.json", "notes.txt"] {
            std::fs::write(folder.path().join(name), format!("old {name}")).unwrap();
        }
        folder
    }

    #[cfg(unix)]
    #[test]
    fn a_link_in_place_of_the_backup_takes_nothing_from_another_run() {
        let (folder, other) = (run(), run());
        let before = content(folder.path());
        std::os::unix::fs::symlink(other.path(), folder.path().join(BACKUP)).unwrap();
        recover(folder.path()).unwrap();
        assert!(content(folder.path()) == before && content(other.path()) == before);
    }

    #[test]
    fn a_replaced_run_is_restored_unless_the_new_one_has_begun() {
        let folder = run();
        let before = content(folder.path());
        let backup = Backup::set(folder.path()).unwrap();
        assert!(!folder.path().join("model.ply").exists());
        // The new run begins files of both kinds.
        std::fs::write(folder.path().join("config.toml"), "new").unwrap();
        std::fs::write(folder.path().join("train.csv"), "new").unwrap();
        drop(backup);
        assert_eq!(content(folder.path()), before);

        // A killed process drops nothing; the next one finds the old run.
        let backup = Backup::set(folder.path()).unwrap();
        std::fs::write(folder.path().join("config.toml"), "new").unwrap();
        std::mem::forget(backup);
        recover(folder.path()).unwrap();
        assert_eq!(content(folder.path()), before);

        let mut backup = Backup::set(folder.path()).unwrap();
        backup.give_up().unwrap();
        drop(backup);
        assert_eq!(content(folder.path()), [("notes.txt".to_owned(), "old notes.txt".to_owned())]);
    }

    #[test]
    fn only_the_partial_files_of_a_killed_process_are_deleted() {
        let folder = run();
        let before = content(folder.path());
        for name in [".tmpAb3xYz", "model.ply.partial", "checkpoint.safetensors.partial"] {
            std::fs::write(folder.path().join(name), "half").unwrap();
        }
        recover(folder.path()).unwrap();
        assert_eq!(content(folder.path()), before);
        for name in [".tmp", ".tmpfile", ".tmp-notes", "notes.txt.partial"] {
            assert!(!is_half_written(name), "{name}");
        }
    }
}
