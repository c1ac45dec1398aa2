//! The words of the house: the field's, as the glossary in CONTRIBUTING.md has them, in lines that fit a window.

use std::path::{Path, PathBuf};

use crate::architecture::{code, files};

/// The longest line, in characters.
const MAX_COLUMNS: usize = 120;

/// Names that no identifier is, in parts between underscores.
const BANNED_PARTS: &str = "\
    lift lifted darkroom yardstick fate fates tally crowd crowded offspring thinnest behind said";

/// Names that no identifier is as a whole.
const BANNED_NAMES: &str = "\
    Against Aside Course Crowded Darkroom Ends HeldRun Interior Kept Law Learning Leftover Lift March Meter Pace \
    Planning Player Print Said Sight Spent Switch Yardstick bring few leftover observes owners pace player rescue \
    room tame";

/// The one who stands in a room is the synthetic set.
const ROOMS: &str = "crates/synth";

/// Phrases that no comment, message or page has, in lower case.
const BANNED_PHRASES: &str = "\
    so many, of nothing, what comes of, come of, what of, comes to be, come to be, whoever, nobody, darkroom, \
    yardstick, lift, lifts, lifted, lifting, offspring, leftover, behind";

/// What stands behind something in space.
const BEHIND: &str = "camera, lens, near plane, image plane, surface, Gaussian, splat, pixel";

fn is_word(character: char) -> bool {
    character.is_alphanumeric() || character == '_'
}

fn is_code(path: &Path) -> bool {
    path.extension().is_some_and(|found| found == "rs" || found == "comp" || found == "glsl")
}

/// Every source and page with its text: Rust, GLSL, scripts and documents.
fn sources() -> Vec<(PathBuf, String)> {
    let folders = ["src", "crates", "build", "tests", "examples"].map(|folder| (folder, "rs"));
    let others = [
        ("shaders-glsl", "comp"),
        ("shaders-glsl", "glsl"),
        ("scripts", "py"),
        ("scripts", "sh"),
        ("docs", "md"),
    ];
    let mut all: Vec<_> = folders
        .into_iter()
        .chain(others)
        .flat_map(|(folder, extension)| files(folder, extension))
        .collect();
    all.retain(|(path, _)| !path.ends_with("house/words.rs"));
    all
}

/// Comments, messages and documents of a file in one line.
fn prose(path: &Path, text: &str) -> String {
    let mut prose = String::new();
    for line in text.lines().map(str::trim) {
        let part = match line.find("//") {
            _ if !is_code(path) => line,
            Some(at) => line[at..].trim_start_matches(['/', '!']),
            // What is within quotes, or a part of a message of several lines.
            None if line.contains('"') || line.ends_with('\\') => line,
            None => continue,
        };
        prose += part.trim();
        prose.push(' ');
    }
    prose
}

/// The banned phrases of a file, each with some words after it.
fn banned(path: &Path, text: &str) -> Vec<String> {
    let (prose, mut found) = (prose(path, text), vec![]);
    let lower = prose.to_ascii_lowercase();
    for phrase in BANNED_PHRASES.split(", ") {
        for (at, _) in lower.match_indices(phrase) {
            let after = &prose[at + phrase.len()..];
            let is_phrase = !lower[..at].ends_with(is_word) && !after.starts_with(is_word);
            // Three words on, such as `the camera`.
            let next = after.split_whitespace().take(4).collect::<Vec<_>>().join(" ");
            let is_in_space =
                phrase == "behind" && BEHIND.split(", ").any(|thing| next.contains(thing));
            if is_phrase && !is_in_space {
                found.push(format!("{}: {phrase} {next}", path.display()));
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
    let broken: Vec<_> = sources().iter().flat_map(|(path, text)| banned(path, text)).collect();
    assert_kept(&broken, "say it in the words of the glossary");
}

#[test]
fn no_identifier_is_a_banned_word() {
    let is_banned_part =
        |part: &str| BANNED_PARTS.split(' ').any(|banned| banned == part.to_ascii_lowercase());
    let mut broken = vec![];
    for (path, text) in sources().into_iter().filter(|(path, _)| is_code(path)) {
        let is_room = path.to_string_lossy().contains(ROOMS);
        for (number, line) in text.lines().enumerate() {
            // Without what is within quotes.
            let code: String = code(line).split('"').step_by(2).collect();
            for name in code.split(|character| !is_word(character)) {
                // The names of tests are sentences.
                let is_sentence = name.matches('_').count() > 3;
                let is_banned = BANNED_NAMES.split(' ').any(|banned| banned == name)
                    || !is_sentence && name.split('_').any(is_banned_part);
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
        let is_page = path.extension().is_some_and(|found| found == "md");
        for (number, line) in text.lines().enumerate().filter(|_| !is_page) {
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
