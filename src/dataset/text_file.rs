//! Text files as editors leave them: a byte-order mark is no text, and may announce 16-bit characters.

use std::path::Path;

use crate::{Error, Result};

/// The text of a file, UTF-8, or UTF-16 behind its mark.
///
/// # Errors
/// [`Error::Input`] where it cannot be read or is no text.
pub(super) fn read_text(path: &Path) -> Result<String> {
    let cannot = |what: String| Error::input(path, format!("cannot be read: {what}"));
    let bytes = std::fs::read(path).map_err(|error| cannot(error.to_string()))?;
    let wide = |to_unit: fn([u8; 2]) -> u16| {
        let units: Vec<u16> =
            bytes[2..].chunks_exact(2).map(|pair| to_unit([pair[0], pair[1]])).collect();
        String::from_utf16(&units).map_err(|error| cannot(error.to_string()))
    };
    match bytes.as_slice() {
        [0xFF, 0xFE, ..] => wide(u16::from_le_bytes),
        [0xFE, 0xFF, ..] => wide(u16::from_be_bytes),
        [0xEF, 0xBB, 0xBF, text @ ..] => utf8(text).map_err(cannot),
        text => utf8(text).map_err(cannot),
    }
}

fn utf8(text: &[u8]) -> Result<String, String> {
    std::str::from_utf8(text).map(str::to_owned).map_err(|error| error.to_string())
}
