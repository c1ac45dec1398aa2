//! A name means one thing, and says what it is: types of the library, constructors, indices and values.

use std::collections::BTreeMap;

use crate::architecture::{code, files, library};

/// Names that do not say of what, or in which order.
const VAGUE: [&str; 2] = ["own", "place"];

/// The forms in which a name `_` is bound.
const BINDINGS: [&str; 13] = [
    "let _ ", "let _:", "mut _ ", "|_|", "|&_|", "(_, ", ", _)", "for _ in", "fn _(", "pub _: ",
    ") _: ", "(_: ", ", _: ",
];

/// The type that a line defines.
fn defined_type(line: &str) -> Option<&str> {
    let mut words = line.split_whitespace().skip_while(|word| {
        word.starts_with("pub") || word.starts_with("crate::") || *word == "unsafe"
    });
    let is_type = ["struct", "enum", "trait", "union"].contains(&words.next()?);
    // A macro's is named by its arguments.
    let name = words.next().filter(|name| is_type && !name.starts_with('$'))?;
    name.split(|letter: char| !letter.is_alphanumeric()).next()
}

/// Whether a line of code defines a constructor `of`, or binds a vague name.
fn is_vague(line: &str) -> bool {
    // Without what is within quotes.
    let line: String = code(line).split('"').step_by(2).collect();
    let is_bound =
        |name: &&str| BINDINGS.iter().any(|form| line.contains(&form.replace('_', name)));
    line.contains("fn of(") || line.contains("fn of<") || VAGUE.iter().any(is_bound)
}

#[test]
fn a_type_name_is_defined_once() {
    let mut defined = BTreeMap::<String, Vec<String>>::new();
    for (path, text) in library() {
        for name in text.lines().filter_map(defined_type) {
            defined.entry(name.to_owned()).or_default().push(path.display().to_string());
        }
    }
    defined.retain(|_, paths| paths.len() > 1);
    assert!(defined.is_empty(), "name each for what it is: {defined:#?}");
}

#[test]
fn no_constructor_is_called_of_and_no_value_own_or_place() {
    let shaders = ["comp", "glsl"].map(|extension| ("shaders-glsl", extension));
    let rust = ["src", "crates", "build", "tests", "examples"].map(|folder| (folder, "rs"));
    let all = rust.into_iter().chain(shaders).flat_map(|(folder, kind)| files(folder, kind));
    let mut vague = vec![];
    for (path, text) in all {
        for (number, line) in text.lines().enumerate().filter(|(_, line)| is_vague(line)) {
            vague.push(format!("{}:{}: {}", path.display(), number + 1, line.trim()));
        }
    }
    assert!(vague.is_empty(), "name it for what it does or is:\n{}", vague.join("\n"));
}

#[test]
fn types_and_vague_names_are_found_in_code_alone() {
    assert_eq!(defined_type("    pub(in crate::cli) struct Pictures<'a> {"), Some("Pictures"));
    assert_eq!(defined_type("pub(super) enum Kind {"), Some("Kind"));
    assert_eq!(defined_type("/// struct Kind"), None);
    assert!(is_vague("let own = 3;") && is_vague("views.map(|place| place + 1)"));
    assert!(!is_vague("/// let own") && !is_vague("let owner = \"let own \";"));
}
