//! The defects that `scripts/plant-defects.py` plants.

use std::fs;
use std::path::Path;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// The string literals of a piece of Python, with escapes of quotes and line breaks resolved.
fn literals(code: &str) -> Vec<String> {
    let (mut found, mut open): (Vec<String>, Option<String>) = (vec![], None);
    let mut characters = code.chars();
    while let Some(character) = characters.next() {
        match (&mut open, character) {
            (Some(_), '"') => found.extend(open.take()),
            (Some(text), '\\') => match characters.next() {
                Some('n') => text.push('\n'),
                escaped => text.extend(escaped),
            },
            (Some(text), _) => text.push(character),
            (None, '"') => open = Some(String::new()),
            (None, '#') => drop(characters.find(|character| *character == '\n')),
            (None, _) => {}
        }
    }
    found
}

#[test]
fn every_planted_defect_replaces_text_that_exists_once() {
    let script = fs::read_to_string(Path::new(ROOT).join("scripts/plant-defects.py")).unwrap();
    let list = script.split("DEFECTS = [").nth(1).unwrap().split("\n]").next().unwrap();
    let literals = literals(list);
    let (defects, rest) = literals.as_chunks::<5>();
    assert!(rest.is_empty() && defects.len() > 50, "{} literals", literals.len());
    for [name, file, before, ..] in defects {
        let text = fs::read_to_string(Path::new(ROOT).join(file)).unwrap();
        assert_eq!(text.matches(before.as_str()).count(), 1, "{name} ({file}): {before}");
    }
}
