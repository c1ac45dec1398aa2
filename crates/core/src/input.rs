//! Files named by the user: read whole, and text in the encodings of editors.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::{Error, Result};

/// The limit for a device or a pipe, in bytes, which may have no end.
const MOST: u64 = 1 << 28;

/// The bytes of a file.
pub fn bytes(path: &Path) -> Result<Vec<u8>> {
    bytes_if(path, |_| true)
}

/// The bytes of a file; only its beginning if `is_wanted` refuses that.
pub fn bytes_if(path: &Path, is_wanted: impl Fn(&[u8]) -> bool) -> Result<Vec<u8>> {
    const BEGINNING: u64 = 1 << 12;
    // Only photographs and datasets are read within archives.
    let is_archive = |above: &&Path| above.is_file();
    let cannot = |error: std::io::Error| match path.ancestors().skip(1).find(is_archive) {
        Some(archive) => {
            Error::input(path, format!("is within {}; extract it first", archive.display()))
        }
        None => unreadable(path, &error),
    };
    let mut file = File::open(path).map_err(cannot)?;
    let is_file = file.metadata().map_err(cannot)?.is_file();
    let mut bytes = vec![];
    file.by_ref().take(BEGINNING).read_to_end(&mut bytes).map_err(cannot)?;
    if !is_wanted(&bytes) {
        return Ok(bytes);
    }
    if is_file {
        file.read_to_end(&mut bytes).map_err(cannot)?;
        return Ok(bytes);
    }
    file.take(MOST).read_to_end(&mut bytes).map_err(cannot)?;
    if bytes.len() as u64 > MOST {
        return Err(Error::input(path, "does not end; name a file"));
    }
    Ok(bytes)
}

/// The error for a file or folder that cannot be read.
pub fn unreadable(path: &Path, why: &impl std::fmt::Display) -> Error {
    let problem =
        format!("cannot be read: {why}; check the path and its permissions, or copy it again");
    Error::input(path, problem)
}

/// The text of a file in UTF-8, or in UTF-16 with a byte-order mark, which is removed.
pub fn text(path: &Path) -> Result<String> {
    decoded(path, &bytes(path)?)
}

/// The text of the bytes of a file.
pub fn decoded(path: &Path, bytes: &[u8]) -> Result<String> {
    let cannot =
        |what: String| Error::input(path, format!("cannot be read: {what}; save it as UTF-8"));
    let wide = |to_unit: fn([u8; 2]) -> u16| {
        let units: Vec<u16> =
            bytes[2..].chunks_exact(2).map(|pair| to_unit([pair[0], pair[1]])).collect();
        String::from_utf16(&units).map_err(|error| cannot(error.to_string()))
    };
    match bytes {
        [0xFF, 0xFE, ..] => wide(u16::from_le_bytes),
        [0xFE, 0xFF, ..] => wide(u16::from_be_bytes),
        [0xEF, 0xBB, 0xBF, text @ ..] => utf8(text).map_err(cannot),
        text => utf8(text).map_err(cannot),
    }
}

fn utf8(text: &[u8]) -> Result<String, String> {
    std::str::from_utf8(text).map(str::to_owned).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    #[test]
    fn an_endless_file_is_refused_and_a_finite_one_is_read() {
        let error = bytes(Path::new("/dev/zero")).unwrap_err().to_string();
        assert!(error.contains("/dev/zero: does not end"), "{error}");
        assert_eq!(bytes(Path::new("/dev/null")).unwrap(), b"");
        assert!(bytes(Path::new("/")).unwrap_err().to_string().contains("cannot be read"));
    }

    #[test]
    fn what_is_not_wanted_is_not_read_and_a_file_within_a_file_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scan.zip");
        let file = File::create(&path).unwrap();
        // More than there is memory.
        file.set_len(1 << 43).unwrap();
        assert!(bytes_if(&path, |start| start.starts_with(b"PK")).unwrap().len() < 1 << 16);
        let error = bytes(&path.join("model.ply")).unwrap_err().to_string();
        assert!(error.contains("model.ply: is within") && error.contains("extract it"), "{error}");
    }

    #[test]
    fn a_byte_order_mark_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("text");
        for marked in [&b"ab"[..], b"\xEF\xBB\xBFab", b"\xFF\xFEa\0b\0", b"\xFE\xFF\0a\0b"] {
            std::fs::write(&path, marked).unwrap();
            assert_eq!(text(&path).unwrap(), "ab");
        }
    }
}
