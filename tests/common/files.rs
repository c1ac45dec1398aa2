//! Files of tests: what is committed, captures that may be absent, and folders. Tests of the crates include it too.

#![allow(dead_code, reason = "no test binary uses everything")]

use std::fs;
use std::ops::Deref;
use std::path::{Path, PathBuf};

pub(crate) use nightsplat_core::testing::not_run;

/// The folder of the repository, from the root package and from those below it.
fn root() -> &'static Path {
    let mut folders = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    folders.find(|folder| folder.join("tests/fixtures").is_dir()).unwrap()
}

/// A file or folder of captures that may be next to the checkout; without it, the rest of the test is not run.
#[track_caller]
pub(crate) fn shared(name: &str) -> Option<PathBuf> {
    let path = root().join("../shared").join(name);
    if path.exists() {
        return Some(path);
    }
    not_run("captures", format_args!("../shared/{name} is absent"));
    None
}

/// A file or folder that is committed with the tests.
pub(crate) fn fixture(name: &str) -> PathBuf {
    root().join("tests/fixtures").join(name)
}

/// Copies a folder.
pub(crate) fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let (path, target) = entry.map(|e| (e.path(), to.join(e.file_name()))).unwrap();
        if path.is_dir() {
            copy(&path, &target);
        } else {
            fs::copy(path, target).unwrap();
        }
    }
}

/// The files of a folder, in order.
pub(crate) fn paths(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    paths
}

/// The names in a folder, in order.
pub(crate) fn file_names(folder: impl AsRef<Path>) -> Vec<String> {
    let names = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name());
    let mut names: Vec<String> = names.map(|name| name.into_string().unwrap()).collect();
    names.sort();
    names
}

/// Every file below a folder, in order.
pub(crate) fn files_below(folder: &Path) -> Vec<PathBuf> {
    let inner = |path: PathBuf| if path.is_dir() { files_below(&path) } else { vec![path] };
    paths(folder).into_iter().flat_map(inner).collect()
}

/// Every file below a folder, by its path there, and its bytes.
pub(crate) fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let one =
        |path: PathBuf| (path.strip_prefix(folder).unwrap().to_owned(), fs::read(&path).unwrap());
    files_below(folder).into_iter().map(one).collect()
}

/// The text must contain all of these parts.
#[track_caller]
pub(crate) fn says(text: &str, parts: &[&str]) {
    for part in parts {
        assert!(text.contains(part), "no `{part}` in: {text}");
    }
}

/// A folder for the files of a test, removed with it. In its commands, `@NAME` is the path of NAME in it.
#[derive(Debug)]
pub(crate) struct Folder(tempfile::TempDir);

impl Deref for Folder {
    type Target = Path;

    fn deref(&self) -> &Path {
        self.0.path()
    }
}

impl AsRef<Path> for Folder {
    fn as_ref(&self) -> &Path {
        self
    }
}

impl Folder {
    pub(crate) fn empty() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    /// A copy of a folder, beside it.
    pub(crate) fn copy_of(folder: &Path) -> Self {
        let copied = Self(tempfile::tempdir_in(folder.parent().unwrap()).unwrap());
        copy(folder, &copied);
        copied
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.join(name)
    }

    pub(crate) fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.join(name)).unwrap()
    }

    pub(crate) fn text(&self, name: &str) -> String {
        fs::read_to_string(self.join(name)).unwrap()
    }

    pub(crate) fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        fs::create_dir_all(self.join(name).parent().unwrap()).unwrap();
        fs::write(self.join(name), content).unwrap();
    }

    /// The model of a run.
    pub(crate) fn model(&self, run: &str) -> Vec<u8> {
        self.read(&format!("{run}/model.ply"))
    }
}
