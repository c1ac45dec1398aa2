//! The documents: their lengths, their links, and the options and settings that they mention.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use crate::architecture::{ROOT, files};

/// The limits of documents, in bytes.
const MAX_BYTES: [(&str, usize); 4] = [
    ("README.md", 8 << 10),
    ("docs/guide.md", 32 << 10),
    ("docs/measurements.md", 42 << 10),
    ("docs/embedding.md", 18 << 10),
];

/// Every document, with its text.
fn documents() -> Vec<(PathBuf, String)> {
    let root =
        ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"].map(|name| Path::new(ROOT).join(name));
    let docs =
        fs::read_dir(Path::new(ROOT).join("docs")).unwrap().map(|entry| entry.unwrap().path());
    let docs = docs.filter(|path| path.extension().is_some_and(|it| it == "md"));
    root.into_iter()
        .chain(docs)
        .map(|path| (path.clone(), fs::read_to_string(path).unwrap()))
        .collect()
}

/// The anchors of a page's headings, as on GitHub.
fn anchors(page: &str) -> BTreeSet<String> {
    let slug = |heading: &str| {
        let kept = heading.trim().chars().filter(|it| it.is_alphanumeric() || "-_ ".contains(*it));
        kept.collect::<String>().to_lowercase().replace(' ', "-")
    };
    prose(page)
        .filter(|line| line.starts_with('#'))
        .map(|line| slug(line.trim_start_matches('#')))
        .collect()
}

/// The lines outside of code blocks.
fn prose(page: &str) -> impl Iterator<Item = &str> {
    page.split("```").step_by(2).flat_map(str::lines)
}

#[test]
fn documents_keep_to_their_lengths() {
    for (name, limit) in MAX_BYTES {
        let bytes = fs::metadata(Path::new(ROOT).join(name)).unwrap().len();
        assert!(bytes <= limit as u64, "{name} has {bytes} bytes, and may have {limit}");
    }
}

#[test]
fn the_site_has_every_document() {
    let summary = fs::read_to_string(Path::new(ROOT).join("docs/SUMMARY.md")).unwrap();
    for (path, _) in
        documents().into_iter().filter(|(path, _)| path.parent().unwrap().ends_with("docs"))
    {
        let name = path.file_name().unwrap().to_str().unwrap();
        assert!(
            name == "SUMMARY.md" || summary.contains(&format!("({name})")),
            "docs/SUMMARY.md lacks {name}"
        );
    }
}

#[test]
fn each_scene_of_the_gallery_has_its_commands_and_a_small_picture() {
    const MAX_BYTES: u64 = 60_000;
    let page = fs::read_to_string(Path::new(ROOT).join("docs/gallery.md")).unwrap();
    let scenes = |start: &'static str| -> Vec<&str> {
        page.split(start).skip(1).filter_map(|it| it.split([' ', '.', '\n', '-']).next()).collect()
    };
    let pictures = scenes("](gallery/");
    assert_eq!(pictures.len(), 5);
    for command in ["nightsplat synth ", "nightsplat train ", "nightsplat render "] {
        assert_eq!(scenes(command), pictures, "{command}");
    }
    let folder = fs::read_dir(Path::new(ROOT).join("docs/gallery")).unwrap();
    for path in folder.map(|entry| entry.unwrap().path()) {
        let (name, bytes) = (path.file_stem().unwrap(), fs::metadata(&path).unwrap().len());
        assert!(pictures.contains(&name.to_str().unwrap()), "{} is shown nowhere", path.display());
        assert!(bytes <= MAX_BYTES, "{} has {bytes} bytes", path.display());
    }
}

#[test]
fn every_path_whose_instructions_are_counted_has_a_count() {
    let read = |name| fs::read_to_string(Path::new(ROOT).join(name)).unwrap();
    let (script, table) = (read("scripts/instructions.sh"), read("docs/instructions.csv"));
    let paths: Vec<&str> =
        script.split("\npath \"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    assert_eq!(paths.len(), 5);
    for line in table.lines().skip(1) {
        let [_, _, path, count] = line.split(',').collect::<Vec<_>>()[..] else {
            panic!("{line} has not commit, compiler, path and instructions")
        };
        assert!(paths.contains(&path) && count.parse::<u64>().unwrap() > 0, "{line}");
    }
    for path in paths {
        assert!(table.contains(&format!(",{path},")), "docs/instructions.csv lacks {path}");
    }
}

#[test]
fn links_lead_to_files_and_headings_that_exist() {
    for (path, page) in documents() {
        let links = page.split("](").skip(1).filter_map(|rest| rest.split(')').next());
        for link in links.filter(|link| !link.contains("://") && !link.contains(' ')) {
            let (file, anchor) =
                link.split_once('#').map_or((link, None), |(file, it)| (file, Some(it)));
            let target =
                if file.is_empty() { path.clone() } else { path.parent().unwrap().join(file) };
            assert!(target.exists(), "{}: {link} leads nowhere", path.display());
            if let Some(anchor) = anchor {
                let found = anchors(&fs::read_to_string(target).unwrap()).contains(anchor);
                assert!(found, "{}: there is no heading for {link}", path.display());
            }
        }
    }
}

/// Code as a reader would type it: lines of code blocks, and code within text.
fn code(page: &str) -> impl Iterator<Item = &str> {
    let blocks = page.split("```").skip(1).step_by(2).flat_map(str::lines);
    blocks.chain(prose(page).flat_map(|line| line.split('`').skip(1).step_by(2)))
}

#[test]
fn options_in_documents_are_options_of_the_command() {
    use clap::CommandFactory;

    fn options(command: &clap::Command) -> BTreeSet<String> {
        let of_command = command
            .get_arguments()
            .flat_map(|it| it.get_long_and_visible_aliases().unwrap_or_default());
        let of_command: BTreeSet<_> = of_command.map(str::to_owned).collect();
        command.get_subcommands().map(options).fold(of_command, |all, more| &all | &more)
    }
    let mut command = nightsplat::cli::Cli::command();
    command.build();
    let known = options(&command);
    let commands: BTreeSet<_> =
        command.get_subcommands().map(|it| it.get_name().to_owned()).collect();

    for (path, page) in documents().into_iter().filter(|(path, _)| !path.ends_with("CHANGELOG.md"))
    {
        for line in code(&page) {
            let first = line.split(' ').next().unwrap();
            let is_ours =
                first == "nightsplat" || first.starts_with("--") || commands.contains(first);
            let line = line.split(" #").next().unwrap();
            let words = line.split([' ', '=']).filter_map(|word| word.strip_prefix("--"));
            for option in words.filter(|_| is_ours) {
                assert!(
                    known.contains(option),
                    "{}: `{line}`: there is no --{option}",
                    path.display()
                );
            }
        }
    }
}

#[test]
fn settings_in_the_guide_and_the_internals_exist() {
    use nightsplat::train::settings::setting;

    let is_key =
        |word: &&str| word.chars().all(|it| it.is_ascii_lowercase() || it == '_' || it == '.');
    let sections =
        ["tone", "start", "schedule", "density", "model", "loss", "stop", "exposure", "precision"];
    for (path, page) in documents() {
        let words = code(&page).flat_map(|line| line.split([' ', '=']));
        let keys =
            words.filter(|word| sections.iter().any(|it| word.starts_with(&format!("{it}."))));
        for key in keys.filter(is_key).filter(|key| !key.ends_with(['.', '_'])) {
            let is_file =
                [".rs", ".ply", ".csv", ".toml", ".md"].iter().any(|it| key.ends_with(it));
            assert!(
                is_file || setting(key).is_some(),
                "{}: there is no setting {key}",
                path.display()
            );
        }
    }
}

#[test]
fn files_and_tests_in_documents_exist() {
    let folders =
        ["src/", "crates/", "tests/", "scripts/", "examples/", "docs/", "shaders-glsl/", "build/"];
    let sources = [files("src", "rs"), files("crates", "rs"), files("tests", "rs")].concat();
    for (path, page) in documents() {
        let words = prose(&page)
            .flat_map(|line| line.split('`').skip(1).step_by(2))
            .flat_map(str::split_whitespace);
        for word in words.filter(|word| !word.contains(char::is_uppercase)) {
            if folders.iter().any(|folder| word.starts_with(folder)) {
                assert!(
                    Path::new(ROOT).join(word).exists(),
                    "{}: there is no {word}",
                    path.display()
                );
            }
            // The name of a test is a sentence; shorter names are modules.
            let test = word.rsplit("::").next().unwrap();
            if word.contains("::") && test.matches('_').count() > 4 {
                let is_test = |(_, text): &(PathBuf, String)| text.contains(&format!("fn {test}("));
                assert!(sources.iter().any(is_test), "{}: there is no test {test}", path.display());
            }
        }
    }
}
