//! What commands print. Only a command whose product is its output fails if that cannot be written; everything else is
//! told beside the work, which goes on whether or not anybody reads.

use std::fmt::Display;
use std::io::{ErrorKind, Write};

use crate::{Error, Result};

/// Prints the product of a command, such as a report or JSON, and a line break unless the text ends with one. A reader
/// that has gone, as in `nightsplat doctor | head`, is no failure.
///
/// # Errors
/// Standard output cannot be written for another reason, such as a full disk.
pub(super) fn print(text: impl Display) -> Result<()> {
    match write(std::io::stdout().lock(), &text) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            let problem = format!("cannot be written ({error}); choose another place");
            Err(Error::output("standard output", problem))
        }
        _ => Ok(()),
    }
}

/// Tells on standard output what is done beside it. No failure ends a command.
pub(super) fn tell(text: impl Display) {
    let _ = write(std::io::stdout().lock(), &text);
}

/// Tells on standard error. No failure ends a command.
pub fn tell_on_stderr(text: impl Display) {
    let _ = write(std::io::stderr().lock(), &text);
}

fn write(mut out: impl Write, text: &impl Display) -> std::io::Result<()> {
    let text = text.to_string();
    let end = if text.ends_with('\n') { "" } else { "\n" };
    out.write_all(format!("{text}{end}").as_bytes())?;
    out.flush()
}
