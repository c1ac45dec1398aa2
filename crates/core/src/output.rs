//! Files that appear when complete, and text that is safe to print.

use std::borrow::Cow;
use std::path::Path;
use std::path::PathBuf;

use crate::error::{acts, escaped};
pub use crate::error::{in_a_line, one_line};
use crate::{Error, Result};

/// Writes a file under a temporary name and renames it when complete.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    write_whole_with(path, |path| std::fs::write(path, bytes))
}

/// [`write_whole`] with a function that writes the file under the given name. The target of a link is replaced, and the
/// link kept; a device or a pipe is written to, not replaced. What has the temporary name is removed, not followed.
pub fn write_whole_with(
    path: &Path,
    write: impl FnOnce(&Path) -> std::io::Result<()>,
) -> Result<()> {
    let failed = |error| {
        Error::output(path, format!("cannot be written ({error}); check the folder and the disk"))
    };
    if path.metadata().is_ok_and(|there| !there.is_file() && !there.is_dir()) {
        return write(path).map_err(failed);
    }
    let target = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let mut partial = target.as_os_str().to_owned();
    partial.push(".partial");
    let partial = Path::new(&partial);
    let written = remove_link_or_file(partial)
        .and_then(|()| std::fs::File::create_new(partial).map(drop))
        .and_then(|()| write(partial))
        .and_then(|()| std::fs::rename(partial, &target));
    written.map_err(|error| {
        // The first failure is the one to report; a remaining temporary file is not.
        let _ = std::fs::remove_file(partial);
        failed(error)
    })
}

/// The path of a file of ours, such as one of a run, for [`write_whole`]: a link that somebody left there is removed,
/// and so is a pipe. Links are followed in paths that the user names.
pub fn own_file(path: PathBuf) -> Result<PathBuf> {
    let is_usual = path.symlink_metadata().map_or(true, |there| there.is_file() || there.is_dir());
    if !is_usual {
        remove_link_or_file(&path)
            .map_err(|error| Error::output(&path, format!("is in the way ({error}); remove it")))?;
    }
    Ok(path)
}

fn remove_link_or_file(path: &Path) -> std::io::Result<()> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// Flushes those of the files that exist, and then their folder, to the disk.
pub fn flush_to_disk(folder: &Path, files: &[&str]) -> Result<()> {
    for path in files.iter().map(|file| folder.join(file)).filter(|path| path.is_file()) {
        // Windows flushes only what may be written.
        let file = std::fs::File::options().read(true).write(cfg!(windows)).open(&path);
        file.and_then(|file| file.sync_all()).map_err(|error| {
            Error::output(&path, format!("cannot be flushed ({error}); check the disk"))
        })?;
    }
    // Not every system can flush a folder.
    let _ = std::fs::File::open(folder).and_then(|folder| folder.sync_all());
    Ok(())
}

/// Creates a folder unless it exists.
pub fn create_folder(folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(|error| {
        Error::output(folder, format!("cannot be created ({error}); choose another place"))
    })
}

/// Creates the folder of a file unless it exists.
pub fn create_folder_of(file: &Path) -> Result<()> {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty());
    folder.map_or(Ok(()), create_folder)
}

/// Whether two paths name the same file.
pub fn is_same_file(a: &Path, b: &Path) -> bool {
    a.canonicalize().ok().zip(b.canonicalize().ok()).is_some_and(|(a, b)| a == b)
}

/// Refuses to write into the photographs that a folder is made from: a folder that is them, that holds them, and unless
/// `may_be_within` one in them. What does not exist yet counts as where it would be.
pub fn check_apart(out: &Path, photographs: &Path, may_be_within: bool) -> Result<()> {
    let (to, from) = (real(out), real(photographs));
    let relation = if to == from {
        "is"
    } else if from.starts_with(&to) {
        "holds"
    } else if to.starts_with(&from) && !may_be_within {
        "lies in"
    } else {
        return Ok(());
    };
    let (out, photographs) = (out.display(), photographs.display());
    Err(Error::Usage(format!(
        "--out {out} {relation} {photographs}, where the photographs are; choose another folder"
    )))
}

/// A path without links, as far as it exists.
fn real(path: &Path) -> PathBuf {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let existing = path.ancestors().find_map(|above| Some((above, above.canonicalize().ok()?)));
    match existing {
        Some((above, real)) => real.join(path.strip_prefix(above).unwrap_or(Path::new(""))),
        None => path,
    }
}

/// A duration in one or two units.
pub fn duration(seconds: f64) -> String {
    match seconds.round() as u64 {
        seconds @ 0..60 => format!("{seconds} s"),
        seconds @ 60..3600 => format!("{} min {} s", seconds / 60, seconds % 60),
        seconds => format!("{} h {} min", seconds / 3600, seconds % 3600 / 60),
    }
}

/// A duration that is estimated: coarse, as it is.
pub fn about(seconds: f64) -> String {
    match seconds {
        ..90.0 => format!("about {:.0} s", 10.0 * (seconds / 10.0).ceil().max(1.0)),
        ..5400.0 => format!("about {:.0} min", (seconds / 60.0).round()),
        _ => format!("about {:.1} h", seconds / 3600.0),
    }
}

/// Text for a terminal: control characters and those of bidirectional text, which foreign names may contain, are
/// escaped. Line breaks are kept.
pub fn printable(text: &str) -> Cow<'_, str> {
    escaped(text, |c| acts(c) && c != '\n')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    #[test]
    fn a_link_and_a_pipe_are_not_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let [file, link, pipe] = ["file", "link", "pipe"].map(|name| folder.path().join(name));
        std::fs::write(&file, "before").unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        write_whole(&link, b"after").unwrap();
        assert!(link.is_symlink() && std::fs::read(&file).unwrap() == b"after");

        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let reader = pipe.clone();
        let reader = std::thread::spawn(move || std::fs::read(reader).unwrap());
        write_whole(&pipe, b"whole").unwrap();
        assert!(!pipe.metadata().unwrap().is_file(), "the pipe was replaced");
        assert_eq!(reader.join().unwrap(), b"whole");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 3);
    }

    #[cfg(unix)]
    #[test]
    fn a_planted_link_decides_nothing_about_a_partial_file_or_a_file_of_ours() {
        let folder = tempfile::tempdir().unwrap();
        let [file, out, partial] =
            ["file", "out", "out.partial"].map(|name| folder.path().join(name));
        std::fs::write(&file, "precious").unwrap();
        std::os::unix::fs::symlink(&file, &partial).unwrap();
        write_whole(&out, b"new").unwrap();
        assert!(!out.is_symlink() && std::fs::read(&out).unwrap() == b"new");
        std::fs::remove_file(&out).unwrap();
        std::os::unix::fs::symlink(&file, &out).unwrap();
        write_whole(&own_file(out.clone()).unwrap(), b"newer").unwrap();
        assert!(!out.is_symlink() && std::fs::read(&out).unwrap() == b"newer");
        assert_eq!(std::fs::read(&file).unwrap(), b"precious");
        // What a killed process left is no obstacle.
        std::fs::write(&partial, "half").unwrap();
        write_whole(&out, b"newest").unwrap();
        assert!(std::fs::read(own_file(out).unwrap()).unwrap() == b"newest" && !partial.exists());
        flush_to_disk(folder.path(), &["file", "absent"]).unwrap();
    }

    #[test]
    fn characters_that_act_on_a_terminal_are_escaped() {
        assert_eq!(printable("größer\nline"), "größer\nline");
        assert_eq!(printable("\u{1b}[31mred\r\u{9b}2J\u{7}"), r"\u{1b}[31mred\r\u{9b}2J\u{7}");
        assert_eq!(one_line("a\nerror: b\u{202e}gnp\u{2069}"), r"a\nerror: b\u{202e}gnp\u{2069}");
    }

    #[test]
    fn what_is_written_stays_apart_from_photographs() {
        let folder = tempfile::tempdir().unwrap();
        let photos = folder.path().join("photos");
        std::fs::create_dir(&photos).unwrap();
        let refused = |out: &Path, within: bool| {
            check_apart(out, &photos, within).err().map(|error| error.to_string())
        };
        for (out, relation) in [
            (photos.join("."), "is"),
            (folder.path().to_owned(), "holds"),
            (photos.join("a/b"), "lies in"),
        ] {
            let message = refused(&out, false).unwrap();
            assert!(message.contains(&format!(" {relation} ")), "{message}");
        }
        assert_eq!(refused(&photos.join("run"), true), None);
        assert_eq!(refused(&folder.path().join("photos-splat/run"), false), None);
        #[cfg(unix)]
        {
            let link = folder.path().join("link");
            std::os::unix::fs::symlink(&photos, &link).unwrap();
            assert!(refused(&link, true).unwrap().contains(" is "));
        }
    }

    #[test]
    fn a_duration_has_two_units_at_most_and_an_estimate_one() {
        let exact = [0.4, 59.4, 60.0, 156.0, 3600.0, 9000.0].map(duration);
        assert_eq!(exact, ["0 s", "59 s", "1 min 0 s", "2 min 36 s", "1 h 0 min", "2 h 30 min"]);
        let coarse = [0.4, 51.0, 156.0, 9000.0].map(about);
        assert_eq!(coarse, ["about 10 s", "about 60 s", "about 3 min", "about 2.5 h"]);
    }
}
