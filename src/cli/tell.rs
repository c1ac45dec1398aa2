//! What commands print. Only a command whose product is its output fails if that cannot be written; everything else is
//! told beside the work, which goes on whether or not anybody reads.

use std::borrow::Cow;
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

/// The width of lines where standard output is no terminal.
const WIDTH: usize = 80;

/// A paragraph in lines of the terminal's width, without breaking a word; further lines are indented.
pub(super) fn wrapped(paragraph: &str, indent: usize) -> String {
    let width = terminal_size::terminal_size_of(std::io::stdout());
    let width = width.map_or(WIDTH, |(width, _)| usize::from(width.0));
    wrapped_to(width, paragraph, indent)
}

fn wrapped_to(width: usize, paragraph: &str, indent: usize) -> String {
    let blanks = " ".repeat(indent);
    let options = textwrap::Options::new(width.max(indent + 20))
        .break_words(false)
        .word_splitter(textwrap::WordSplitter::NoHyphenation)
        .subsequent_indent(&blanks);
    let lines = textwrap::wrap(paragraph, options);
    lines.into_iter().map(|line: Cow<'_, str>| line.trim_end().to_owned() + "\n").collect()
}

fn write(mut out: impl Write, text: &impl Display) -> std::io::Result<()> {
    let text = text.to_string();
    let end = if text.ends_with('\n') { "" } else { "\n" };
    out.write_all(format!("{text}{end}").as_bytes())?;
    out.flush()
}

#[cfg(test)]
mod tests {
    use super::wrapped_to;

    #[test]
    fn words_are_kept_whole_and_lines_within_the_width() {
        let text = "exposure  off  exposures spread by 0.05 stops at shared points, /a/long/path/of/more/than/20 \
                    --set a=b";
        let lines = wrapped_to(40, text, 15);
        let words = |text: &str| text.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
        assert_eq!(words(&lines), words(text));
        assert!(
            lines.starts_with("exposure  off  exposures spread by 0.05\n               stops"),
            "{lines}"
        );
        assert!(
            lines.lines().all(|line| line.len() <= 40 || !line.trim_start().contains(' ')),
            "{lines}"
        );
        assert_eq!(wrapped_to(80, "", 0), "\n");
    }
}
