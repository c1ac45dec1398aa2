//! No two modules use each other, at any depth, asserted on the sources.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::architecture::{code, library};

/// A module, by its path from the crate's root.
type Module = Vec<String>;

/// A module's file: the paths in its code, and the items that it re-exports from its children.
struct Source {
    module: Module,
    paths: Vec<Module>,
    /// By item, the child that defines it.
    imported: BTreeMap<String, String>,
}

fn module_of(path: &Path) -> Module {
    let path = path.with_extension("");
    let names = path.iter().map(|name| name.to_str().unwrap());
    names.skip_while(|name| *name != "src").skip(1).map(str::to_owned).collect()
}

/// The paths of a use tree: `a::{b, c::D}` is `a::b` and `a::c::D`. Returns the text after the tree.
fn tree<'a>(mut text: &'a str, before: &Module, found: &mut Vec<Module>) -> &'a str {
    let mut path = before.clone();
    loop {
        text = text.trim_start();
        if let Some(inner) = text.strip_prefix('{') {
            text = inner;
            loop {
                text = tree(text, &path, found).trim_start();
                match text.strip_prefix(',') {
                    Some(rest) => text = rest,
                    None => return text.strip_prefix('}').unwrap_or(text),
                }
            }
        }
        let end = text.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(text.len());
        if end > 0 {
            path.push(text[..end].to_owned());
        }
        match text[end..].strip_prefix("::") {
            Some(rest) => text = rest,
            None => {
                if path.len() > before.len() {
                    found.push(path);
                }
                return &text[end..];
            }
        }
    }
}

/// Every path of code that begins with `crate`, `super` or, after `use`, with one of the module's own names.
pub(crate) fn paths(text: &str) -> Vec<Module> {
    let text = text.lines().map(code).collect::<Vec<_>>().join("\n");
    let mut found = vec![];
    for root in ["crate::", "super::", "use "] {
        for (at, _) in text.match_indices(root) {
            let continues =
                text[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':');
            if !continues {
                let from = if root == "use " { at + root.len() } else { at };
                tree(&text[from..], &vec![], &mut found);
            }
        }
    }
    found
}

fn read(path: &Path, text: &str) -> Source {
    let shipped = text.split("#[cfg(test)]\nmod ").next().unwrap();
    let paths = paths(shipped);
    let imports = paths
        .iter()
        .filter(|path| path.len() > 1 && !["crate", "super"].contains(&path[0].as_str()));
    let imported = imports.map(|path| (path[path.len() - 1].clone(), path[0].clone())).collect();
    Source { module: module_of(path), paths, imported }
}

/// The module to which a path in another module leads, as far as its segments are modules or their items.
fn resolved(from: &Module, path: &Module, sources: &BTreeMap<Module, Source>) -> Option<Module> {
    let supers = path.iter().take_while(|name| *name == "super").count();
    let (mut at, names) = match path[0].as_str() {
        "crate" => (vec![], &path[1..]),
        "super" => (from[..from.len().checked_sub(supers)?].to_vec(), &path[supers..]),
        _ => return None,
    };
    for name in names {
        let child: Module = at.iter().cloned().chain([name.clone()]).collect();
        let item = sources.get(&at).and_then(|source| source.imported.get(name));
        let through = item.map(|owner| at.iter().cloned().chain([owner.clone()]).collect());
        match [Some(child), through]
            .into_iter()
            .flatten()
            .find(|module| sources.contains_key(module))
        {
            Some(module) => at = module,
            None => break,
        }
    }
    Some(at)
}

/// For each module, the siblings that it or its descendants use.
fn used_siblings(sources: &BTreeMap<Module, Source>) -> BTreeMap<Module, BTreeSet<Module>> {
    let mut used: BTreeMap<Module, BTreeSet<Module>> = BTreeMap::new();
    for source in sources.values() {
        for path in &source.paths {
            let Some(target) = resolved(&source.module, path, sources) else { continue };
            let shared = source.module.iter().zip(&target).take_while(|(a, b)| a == b).count();
            if shared < source.module.len() && shared < target.len() {
                let module = source.module[..=shared].to_vec();
                used.entry(module).or_default().insert(target[..=shared].to_vec());
            }
        }
    }
    used
}

/// Whether `to` is reachable from `from`.
fn reaches(from: &Module, to: &Module, used: &BTreeMap<Module, BTreeSet<Module>>) -> bool {
    let mut seen = BTreeSet::new();
    let mut open = vec![from];
    while let Some(module) = open.pop() {
        for next in used.get(module).into_iter().flatten() {
            if next == to {
                return true;
            }
            if seen.insert(next) {
                open.push(next);
            }
        }
    }
    false
}

fn circles(files: &[(PathBuf, String)]) -> Vec<String> {
    let sources = files.iter().map(|(path, text)| read(path, text));
    let sources: BTreeMap<Module, Source> =
        sources.map(|source| (source.module.clone(), source)).collect();
    let used = used_siblings(&sources);
    let pairs =
        used.iter().flat_map(|(module, others)| others.iter().map(move |other| (module, other)));
    let circular = pairs.filter(|(module, other)| reaches(other, module, &used));
    circular
        .map(|(module, other)| format!("{} -> {}", module.join("::"), other.join("::")))
        .collect()
}

#[test]
fn modules_that_use_each_other_are_found() {
    let file = |path: &str, text: &str| (PathBuf::from(path), text.to_owned());
    let mut sources = vec![
        file("src/a.rs", "mod b;\nmod c;\nmod d;\nuse c::{Thing, other};"),
        file("src/a/b.rs", "use super::Thing;"),
        file("src/a/c.rs", "use super::d::X;"),
        file("src/a/d.rs", "use crate::{e::Y, a::{self}};"),
        file("src/e.rs", ""),
    ];
    assert!(circles(&sources).is_empty(), "{:?}", circles(&sources));
    sources[3].1.push_str("\nfn f() { crate::a::b::g() }");
    assert_eq!(circles(&sources), ["a::b -> a::c", "a::c -> a::d", "a::d -> a::b"]);
}

#[test]
fn no_two_modules_use_each_other() {
    let mut by_crate = BTreeMap::<PathBuf, Vec<_>>::new();
    // Unit tests in a file of their own use what they like.
    for (path, text) in library().into_iter().filter(|(path, _)| !path.ends_with("tests.rs")) {
        let before = path.iter().take_while(|name| *name != "src").collect();
        by_crate.entry(before).or_default().push((path, text));
    }
    let found: Vec<_> = by_crate.values().flat_map(|files| circles(files)).collect();
    assert!(found.is_empty(), "{found:#?}");
}
