//! Files named by the user: read whole, and text in the encodings of editors.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::{Error, Result};

/// The limit for a device or a pipe, in bytes, which may have no end.
const MOST: u64 = 1 << 28;

/// The bytes of a file.
pub fn bytes(path: &Path) -> Result<Vec<u8>> {
    let cannot = |error: std::io::Error| Error::input(path, format!("cannot be read: {error}"));
    if path.metadata().is_ok_and(|there| there.is_file()) {
        return std::fs::read(path).map_err(cannot);
    }
    let mut bytes = vec![];
    let file = File::open(path).map_err(cannot)?;
    file.take(MOST + 1).read_to_end(&mut bytes).map_err(cannot)?;
    if bytes.len() as u64 > MOST {
        return Err(Error::input(path, "does not end; name a file"));
    }
    Ok(bytes)
}

/// The first bytes of a file, at most `most`; `None` for what is not read twice, such as a pipe.
pub fn start(path: &Path, most: u64) -> Option<std::io::Result<Vec<u8>>> {
    let read = || {
        let mut bytes = vec![];
        File::open(path)?.take(most).read_to_end(&mut bytes)?;
        Ok(bytes)
    };
    path.is_file().then(read)
}

/// The text of a file in UTF-8, or in UTF-16 with a byte-order mark, which is removed.
pub fn text(path: &Path) -> Result<String> {
    decoded(path, &bytes(path)?)
}

/// The text of the bytes of a file.
pub fn decoded(path: &Path, bytes: &[u8]) -> Result<String> {
    let cannot = |what: String| Error::input(path, format!("cannot be read: {what}"));
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
    fn a_byte_order_mark_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("text");
        for marked in [&b"ab"[..], b"\xEF\xBB\xBFab", b"\xFF\xFEa\0b\0", b"\xFE\xFF\0a\0b"] {
            std::fs::write(&path, marked).unwrap();
            assert_eq!(text(&path).unwrap(), "ab");
        }
    }
}
