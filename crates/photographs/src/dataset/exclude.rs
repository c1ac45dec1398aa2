//! Photographs that are left out by name.

use std::path::Path;

use glob::Pattern;
use nightsplat_core::{Error, Result};

use super::listed::ViewEntry;
use crate::image::files::stem;
use crate::tree;

/// Whether a text is a pattern.
pub fn is_pattern(text: &str) -> bool {
    !text.is_empty() && Pattern::new(text).is_ok()
}

/// The pattern of a name alone.
pub fn pattern_of(name: &str) -> String {
    Pattern::escape(name)
}

/// The patterns of a file, one a line; empty lines and lines after # are skipped.
pub fn patterns_of(path: &Path) -> Result<Vec<String>> {
    let text = tree::text(path)?;
    let lines = (1..).zip(text.lines().map(str::trim));
    let mut patterns = vec![];
    for (number, line) in lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#')) {
        if !is_pattern(line) {
            let problem =
                format!("line {number}: `{line}` is no pattern; `*`, `?` and `[abc]` match");
            return Err(Error::input(path, problem));
        }
        patterns.push(line.to_owned());
    }
    Ok(patterns)
}

/// Removes the views that a pattern matches: their name, their file name, or their path as listed. Other views keep
/// their split.
pub(super) fn exclude(root: &Path, frames: &mut Vec<ViewEntry>, patterns: &[String]) -> Result<()> {
    for text in patterns {
        // Invalid patterns are refused where they are set.
        let Ok(pattern) = Pattern::new(text) else { continue };
        let matches = |frame: &ViewEntry| {
            let listed = frame.listed.replace('\\', "/");
            let file = listed.rsplit('/').next().unwrap_or_default();
            [frame.name.as_str(), stem(file), file, &listed]
                .iter()
                .any(|name| pattern.matches(name))
        };
        let before = frames.len();
        frames.retain(|frame| !matches(frame));
        if frames.len() == before {
            let problem = format!("has no photograph that `{text}` matches; correct exclude");
            return Err(Error::input(root, problem));
        }
        tracing::info!("{}: {} photographs match {text}", root.display(), before - frames.len());
    }
    Ok(())
}
