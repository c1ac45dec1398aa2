//! The words of the house: the field's, as the glossary in CONTRIBUTING.md has them, in lines that fit a window.

use std::path::{Path, PathBuf};

use crate::architecture::{code, files};

/// The longest line, in characters.
const MAX_COLUMNS: usize = 120;

/// Names that no identifier is, in parts between underscores.
const BANNED_PARTS: &[&str] = &[
    "lift",
    "lifted",
    "darkroom",
    "yardstick",
    "fate",
    "fates",
    "tally",
    "crowd",
    "crowded",
    "offspring",
    "thinnest",
    "behind",
    "said",
];

/// Names that no identifier is as a whole.
const BANNED_NAMES: &[&str] = &[
    "Against",
    "Aside",
    "Course",
    "Crowded",
    "Darkroom",
    "Ends",
    "HeldRun",
    "Interior",
    "Kept",
    "Law",
    "Learning",
    "Leftover",
    "Lift",
    "March",
    "Meter",
    "Pace",
    "Planning",
    "Player",
    "Print",
    "Said",
    "Sight",
    "Spent",
    "Switch",
    "Yardstick",
    "bring",
    "few",
    "leftover",
    "observes",
    "owners",
    "pace",
    "player",
    "rescue",
    "room",
    "tame",
];

/// The one who stands in a room is the synthetic set.
const ROOMS: &str = "photographs/dataset/synthetic";

/// Phrases that no comment, message or page has, in lower case.
const BANNED_PHRASES: &[&str] = &[
    "so many",
    "none of nothing",
    "of nothing",
    "what comes of",
    "come of",
    "what of",
    "comes to be",
    "come to be",
    "whoever",
    "nobody",
    "darkroom",
    "yardstick",
    "lift",
    "lifts",
    "lifted",
    "lifting",
    "offspring",
    "leftover",
    "behind",
];

/// What stands behind something in space.
const BEHIND: &[&str] = &[
    "camera",
    "cameras",
    "lens",
    "near plane",
    "image plane",
    "surface",
    "Gaussian",
    "splat",
    "pixel",
];

fn is_word(character: char) -> bool {
    character.is_alphanumeric() || character == '_'
}

/// Every source and page with its text: Rust, GLSL, scripts and documents.
fn sources() -> Vec<(PathBuf, String)> {
    let mut all = vec![];
    for (folder, extensions) in [
        ("src", &["rs"][..]),
        ("build", &["rs"]),
        ("tests", &["rs"]),
        ("examples", &["rs"]),
        ("shaders-glsl", &["comp", "glsl"]),
        ("scripts", &["py", "sh"]),
        ("docs", &["md"]),
    ] {
        all.extend(extensions.iter().flat_map(|extension| files(folder, extension)));
    }
    all.retain(|(path, _)| !path.ends_with("house/words.rs"));
    all
}

/// Comments, messages and documents of a file in one line, in lower case.
fn prose(path: &Path, text: &str) -> String {
    let is_source = path
        .extension()
        .is_some_and(|found| ["rs", "comp", "glsl"].iter().any(|own| found == *own));
    let mut prose = String::new();
    for line in text.lines() {
        let line = line.trim();
        let part = match line.find("//") {
            _ if !is_source => line,
            Some(at) => line[at..].trim_start_matches(['/', '!']),
            // What is within quotes, or a part of a message of several lines.
            None if line.contains('"') || line.ends_with('\\') => line,
            None => continue,
        };
        prose.push_str(part.trim());
        prose.push(' ');
    }
    prose
}

/// The banned phrases of a file, each with some words around it.
fn banned(path: &Path, text: &str) -> Vec<String> {
    let (prose, mut found) = (prose(path, text), vec![]);
    let lower = prose.to_ascii_lowercase();
    for phrase in BANNED_PHRASES {
        for (at, _) in lower.match_indices(phrase) {
            let after = &prose[at + phrase.len()..];
            let is_phrase = !lower[..at].ends_with(is_word) && !after.starts_with(is_word);
            // Three words on, such as `the camera`.
            let next: Vec<&str> = after.split_whitespace().take(4).collect();
            let is_in_space =
                *phrase == "behind" && BEHIND.iter().any(|thing| next.join(" ").contains(thing));
            if is_phrase && !is_in_space {
                let before = prose[..at].split_whitespace().rev().take(4).collect::<Vec<_>>();
                let before: Vec<&str> = before.into_iter().rev().collect();
                found.push(format!(
                    "{}: {} {phrase} {}",
                    path.display(),
                    before.join(" "),
                    next.join(" ")
                ));
            }
        }
    }
    found
}

fn assert_kept(broken: &[String], rule: &str) {
    assert!(broken.is_empty(), "{rule}:\n{}", broken.join("\n"));
}

#[test]
fn no_comment_message_or_page_has_a_banned_phrase() {
    let mut broken = vec![];
    for (path, text) in sources() {
        broken.extend(banned(&path, &text));
    }
    assert_kept(&broken, "say it in the words of the glossary");
}

#[test]
fn no_identifier_is_a_banned_word() {
    let mut broken = vec![];
    for (path, text) in sources() {
        let is_code = path
            .extension()
            .is_some_and(|found| ["rs", "comp", "glsl"].iter().any(|own| found == *own));
        let is_room = path.to_string_lossy().contains(ROOMS);
        for (number, line) in text.lines().enumerate().filter(|_| is_code) {
            // Without what is within quotes.
            let code: String = code(line).split('"').step_by(2).collect();
            for name in code.split(|character| !is_word(character)) {
                // The names of tests are sentences.
                let is_sentence = name.matches('_').count() > 3;
                let has_part = || {
                    name.split('_')
                        .any(|part| BANNED_PARTS.contains(&part.to_ascii_lowercase().as_str()))
                };
                let is_banned = BANNED_NAMES.contains(&name) || !is_sentence && has_part();
                if is_banned && !(is_room && ["room", "lift"].contains(&name)) {
                    broken.push(format!("{}:{}: {name}", path.display(), number + 1));
                }
            }
        }
    }
    assert_kept(&broken, "name it by the glossary");
}

#[test]
fn no_line_is_too_long() {
    let mut broken = vec![];
    for (path, text) in sources() {
        if path.extension().is_some_and(|found| found == "md") {
            continue;
        }
        for (number, line) in text.lines().enumerate() {
            let columns = line.chars().count();
            if columns > MAX_COLUMNS {
                broken.push(format!("{}:{}: {columns} columns", path.display(), number + 1));
            }
        }
    }
    assert_kept(&broken, "wrap it");
}

#[test]
fn a_banned_phrase_is_found_as_whole_words_in_prose_and_across_lines() {
    let found = |text: &str| banned(Path::new("src/a.rs"), text).len();
    assert_eq!(found("/// There are so\n/// many of them."), 1);
    assert_eq!(found("let so_many = many; // not so manyfold"), 0);
    assert_eq!(found("    \"the curve lifts it\""), 1);
    assert_eq!(found("// shoplifting behind the camera, behind a near plane"), 0);
    assert_eq!(found("// the steps behind it"), 1);
}
