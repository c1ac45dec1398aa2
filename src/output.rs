//! Files that are never seen half-written.

use std::path::Path;

use crate::{Error, Result};

/// Writes a file under another name first; it appears under its own once it is complete, or not at all.
///
/// # Errors
/// [`Error::Output`] names the file; nothing is left of it.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    write_whole_with(path, |path| std::fs::write(path, bytes))
}

/// As [`write_whole`], for what writes the file itself, under the name that it is given.
///
/// # Errors
/// As there.
pub fn write_whole_with(
    path: &Path,
    write: impl FnOnce(&Path) -> std::io::Result<()>,
) -> Result<()> {
    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    let partial = Path::new(&partial);
    let written = write(partial).and_then(|()| std::fs::rename(partial, path));
    written.map_err(|error| {
        // The first failure is the one worth reporting; a leftover of it is not.
        let _ = std::fs::remove_file(partial);
        Error::output(path, format!("cannot be written ({error}); check the folder and the disk"))
    })
}
