//! One training at a time in a run directory.
//!
//! The lock is advisory and belongs to the open file: it is released when the process ends. The file contains the
//! process id, for the error message of a second process, and is removed at the end.

use std::fs::{File, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};

use crate::{Error, Result};

/// An exclusive lock on a run directory.
#[derive(Debug)]
pub(crate) struct RunLock {
    path: PathBuf,
    /// The open file that has the lock.
    _file: File,
}

const LOCK: &str = ".lock";

impl RunLock {
    pub(super) fn take(run: &Path) -> Result<Self> {
        let path = run.join(LOCK);
        let unusable = |error: std::io::Error| {
            Error::output(run, format!("cannot be locked ({error}); check the folder and the disk"))
        };
        loop {
            refuse_other(run, &path)?;
            let options =
                File::options().read(true).write(true).create(true).truncate(false).clone();
            let mut file = options.open(&path).map_err(unusable)?;
            match file.try_lock() {
                Err(TryLockError::WouldBlock) => return Err(taken(run, &path)),
                // The file system has no locks; users must not train twice at a time.
                Err(TryLockError::Error(_)) | Ok(()) => {}
            }
            // The previous owner may have removed the file in between.
            if is_at(&file, &path) {
                let process = format!("{}\n", std::process::id());
                file.set_len(0)
                    .and_then(|()| file.write_all(process.as_bytes()))
                    .map_err(unusable)?;
                return Ok(Self { path, _file: file });
            }
        }
    }

    /// Checks that [`RunLock::take`] would succeed.
    pub(super) fn check(run: &Path) -> Result<()> {
        let path = run.join(LOCK);
        refuse_other(run, &path)?;
        match File::open(&path).map(|file| file.try_lock_shared()) {
            Ok(Err(TryLockError::WouldBlock)) => Err(taken(run, &path)),
            _ => Ok(()),
        }
    }
}

impl Drop for RunLock {
    fn drop(&mut self) {
        // After the removal no other process opens the file, and the lock ends with it.
        let _ = std::fs::remove_file(&self.path);
    }
}

/// Refuses what is no file: opening a pipe waits, and a link leads to somebody's file.
fn refuse_other(run: &Path, path: &Path) -> Result<()> {
    match path.symlink_metadata() {
        Ok(there) if !there.is_file() => {
            Err(Error::output(run, format!("has {LOCK}, which is no file; remove it")))
        }
        _ => Ok(()),
    }
}

fn taken(run: &Path, path: &Path) -> Error {
    let process = std::fs::read_to_string(path).unwrap_or_default();
    let process = match process.trim() {
        "" => "another process".to_owned(),
        number => format!("process {number}"),
    };
    Error::output(
        run,
        format!("{process} works in it; wait until that ends, or name another folder"),
    )
}

#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let both = file.metadata().ok().zip(path.metadata().ok());
    both.is_some_and(|(ours, there)| (ours.dev(), ours.ino()) == (there.dev(), there.ino()))
}

/// An open file cannot be removed.
#[cfg(not(unix))]
fn is_at(_: &File, _: &Path) -> bool {
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_training_in_a_directory_is_refused_and_the_first_process_named() {
        let folder = tempfile::tempdir().unwrap();
        let held = RunLock::take(folder.path()).unwrap();
        for error in
            [RunLock::take(folder.path()).unwrap_err(), RunLock::check(folder.path()).unwrap_err()]
        {
            let message = error.to_string();
            let process = format!("process {} works in it", std::process::id());
            assert!(
                message.contains(&process) && message.contains(folder.path().to_str().unwrap()),
                "{message}"
            );
        }
        drop(held);
        RunLock::check(folder.path()).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "it leaves no file");
        // The file of a killed process is no lock.
        std::fs::write(folder.path().join(LOCK), "1\n").unwrap();
        drop(RunLock::take(folder.path()).unwrap());
    }

    #[cfg(unix)]
    #[test]
    fn a_pipe_or_a_link_in_place_of_the_lock_is_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let (run, file) = (folder.path().join("run"), folder.path().join("file"));
        std::fs::write(&file, "precious").unwrap();
        for words in [vec!["mkfifo"], vec!["ln", "-s", file.to_str().unwrap()]] {
            std::fs::create_dir(&run).unwrap();
            let mut plant = std::process::Command::new(words[0]);
            assert!(plant.args(&words[1..]).arg(run.join(LOCK)).status().unwrap().success());
            for refused in [RunLock::take(&run).map(drop), RunLock::check(&run)] {
                let message = refused.unwrap_err().to_string();
                assert!(message.contains("has .lock, which is no file"), "{message}");
            }
            std::fs::remove_dir_all(&run).unwrap();
        }
        assert_eq!(std::fs::read(file).unwrap(), b"precious");
    }
}
