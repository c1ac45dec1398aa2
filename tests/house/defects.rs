//! The defects that `scripts/plant-defects.py` plants, and the failures that `scripts/known-failures` lists.

use std::fs;
use std::path::{Path, PathBuf};

use crate::architecture::{ROOT, files};

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

/// Paths of the functions of a test program or of the library, such as `render::golden_setups`.
fn functions(folder: &str) -> Vec<String> {
    let of_file = |(path, text): &(PathBuf, String)| {
        let module = path.strip_prefix(folder).unwrap().with_extension("");
        let module = module.to_str().unwrap().replace('/', "::");
        let after = text.split("fn ").skip(1).map(|after| after.split('(').next().unwrap());
        after.map(|name| format!("{module}::{name}")).collect::<Vec<_>>()
    };
    files(folder, "rs").iter().flat_map(of_file).collect()
}

/// The defects of the script: name, file, text, its replacement, arguments of `cargo test`.
fn defects() -> Vec<[String; 5]> {
    let script = fs::read_to_string(Path::new(ROOT).join("scripts/plant-defects.py")).unwrap();
    let list = script.split("DEFECTS = [").nth(1).unwrap().split("\n]").next().unwrap();
    let literals = literals(list);
    let (defects, rest) = literals.as_chunks::<5>();
    assert!(rest.is_empty() && defects.len() > 50, "{} literals", literals.len());
    defects.to_vec()
}

#[test]
fn every_planted_defect_has_a_test() {
    for [name, .., arguments] in defects() {
        let words: Vec<&str> = arguments.split(' ').collect();
        if let ["--test", program, filter] = words[..] {
            let is_found =
                functions(&format!("tests/{program}")).iter().any(|path| path.contains(filter));
            assert!(is_found, "{name}: {arguments}");
        }
    }
}

#[test]
fn every_planted_defect_replaces_text_that_exists_once() {
    for [name, file, before, ..] in defects() {
        let text = fs::read_to_string(Path::new(ROOT).join(&file)).unwrap();
        assert_eq!(text.matches(before.as_str()).count(), 1, "{name} ({file}): {before}");
    }
}

#[test]
fn every_known_failure_is_a_test() {
    let mut all: Vec<String> = fs::read_dir(Path::new(ROOT).join("tests"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|folder| folder != "fixtures")
        .flat_map(|program| functions(&format!("tests/{program}")))
        .collect();
    all.extend(functions("src").iter().map(|path| match path.rsplit_once("::") {
        Some((module, name)) => format!("{module}::tests::{name}"),
        None => path.clone(),
    }));
    for (path, text) in files("scripts/known-failures", "txt") {
        for line in text.lines().filter(|line| !line.is_empty() && !line.starts_with('#')) {
            let name = line.trim_start_matches("skip ");
            assert!(all.iter().any(|known| known == name), "{path:?}: {name}");
        }
    }
}
