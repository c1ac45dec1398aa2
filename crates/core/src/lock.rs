//! One process at a time in a folder.
//!
//! The lock is advisory and belongs to the open file: it is released when the last process that has it open ends, which
//! may be one that was started with it. The file contains the process id, for the error message of a second process,
//! and is removed at the end.

use std::fs::{File, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Stdio;

use crate::{Error, Result};

/// An exclusive lock on a folder.
#[derive(Debug)]
pub struct FolderLock {
    path: PathBuf,
    /// The open file that has the lock.
    file: File,
}

const LOCK: &str = ".lock";

impl FolderLock {
    /// Takes the lock of an existing folder.
    ///
    /// # Errors
    /// Another process has it, or the folder cannot be written.
    pub fn take(folder: &Path) -> Result<Self> {
        let path = folder.join(LOCK);
        let unusable = |error: std::io::Error| {
            Error::output(
                folder,
                format!("cannot be locked ({error}); check the folder and the disk"),
            )
        };
        loop {
            refuse_other(folder, &path)?;
            let options =
                File::options().read(true).write(true).create(true).truncate(false).clone();
            let mut file = options.open(&path).map_err(unusable)?;
            match file.try_lock() {
                Err(TryLockError::WouldBlock) => return Err(taken(folder, &path)),
                // The file system has no locks; users must not train twice at a time.
                Err(TryLockError::Error(_)) | Ok(()) => {}
            }
            // The previous owner may have removed the file in between.
            if is_at(&file, &path) {
                let process = format!("{}\n", std::process::id());
                file.set_len(0)
                    .and_then(|()| file.write_all(process.as_bytes()))
                    .map_err(unusable)?;
                return Ok(Self { path, file });
            }
        }
    }

    /// The lock as the standard input of a process, which then holds it as long as it runs, too.
    ///
    /// # Errors
    /// The system has no more handles.
    pub fn shared(&self) -> std::io::Result<Stdio> {
        self.file.try_clone().map(Stdio::from)
    }

    /// Names the process that works in the folder for this one.
    pub fn name(&self, process: u32) {
        // It is for a message.
        let _ = std::fs::write(&self.path, format!("{process}\n"));
    }

    /// Removes its file, before the folder gets another name.
    pub fn remove_file(&self) {
        // A lock without a file is none for others, as at the end.
        let _ = std::fs::remove_file(&self.path);
    }

    /// Checks that [`FolderLock::take`] would succeed.
    pub fn check(folder: &Path) -> Result<()> {
        let path = folder.join(LOCK);
        refuse_other(folder, &path)?;
        match File::open(&path).map(|file| file.try_lock_shared()) {
            Ok(Err(TryLockError::WouldBlock)) => Err(taken(folder, &path)),
            _ => Ok(()),
        }
    }
}

impl Drop for FolderLock {
    fn drop(&mut self) {
        // After the removal no other process opens the file, and the lock ends with it.
        self.remove_file();
    }
}

/// Refuses what is no file: opening a pipe waits, and a link leads to somebody's file.
fn refuse_other(folder: &Path, path: &Path) -> Result<()> {
    match path.symlink_metadata() {
        Ok(there) if !there.is_file() => {
            Err(Error::output(folder, format!("has {LOCK}, which is no file; remove it")))
        }
        _ => Ok(()),
    }
}

fn taken(folder: &Path, path: &Path) -> Error {
    let process = std::fs::read_to_string(path).unwrap_or_default();
    let process = match process.trim() {
        "" => "another process".to_owned(),
        number => format!("process {number}"),
    };
    Error::output(
        folder,
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
        let held = FolderLock::take(folder.path()).unwrap();
        for error in [
            FolderLock::take(folder.path()).unwrap_err(),
            FolderLock::check(folder.path()).unwrap_err(),
        ] {
            let message = error.to_string();
            let process = format!("process {} works in it", std::process::id());
            assert!(
                message.contains(&process) && message.contains(folder.path().to_str().unwrap()),
                "{message}"
            );
        }
        drop(held);
        FolderLock::check(folder.path()).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "it leaves no file");
        // The file of a killed process is no lock.
        std::fs::write(folder.path().join(LOCK), "1\n").unwrap();
        drop(FolderLock::take(folder.path()).unwrap());
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
            for refused in [FolderLock::take(&run).map(drop), FolderLock::check(&run)] {
                let message = refused.unwrap_err().to_string();
                assert!(message.contains("has .lock, which is no file"), "{message}");
            }
            std::fs::remove_dir_all(&run).unwrap();
        }
        assert_eq!(std::fs::read(file).unwrap(), b"precious");
    }
}
