//! Files that are never seen half-written, and text that does only what text does.

use std::borrow::Cow;
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

/// Text for a terminal or a line of a log: control characters, which names from elsewhere may hold, are spelled out. Line
/// breaks stay.
pub fn printable(text: &str) -> Cow<'_, str> {
    let acts = |c: char| c.is_control() && c != '\n';
    if !text.contains(acts) {
        return Cow::Borrowed(text);
    }
    let spelled = |c: char| if acts(c) { c.escape_default().to_string() } else { c.to_string() };
    Cow::Owned(text.chars().map(spelled).collect())
}

/// A field of a CSV file (RFC 4180) in one line: control characters, line breaks too, become underscores.
pub fn csv_field(text: &str) -> String {
    let plain = text.replace(char::is_control, "_");
    if plain.contains([',', '"']) { format!("\"{}\"", plain.replace('"', "\"\"")) } else { plain }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_would_act_on_a_terminal_is_spelled_out() {
        assert_eq!(printable("größer\nline"), "größer\nline");
        assert_eq!(printable("\u{1b}[31mred\r\u{9b}2J\u{7}"), r"\u{1b}[31mred\r\u{9b}2J\u{7}");
    }

    #[test]
    fn a_field_stays_one_field_of_one_line() {
        for (text, field) in [
            ("IMG_1", "IMG_1"),
            ("a,b", "\"a,b\""),
            ("say \"no\"", "\"say \"\"no\"\"\""),
            ("two\nlines", "two_lines"),
            ("\u{1b}[2J,x", "\"_[2J,x\""),
        ] {
            assert_eq!(csv_field(text), field);
        }
    }
}
