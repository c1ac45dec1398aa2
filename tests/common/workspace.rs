//! A folder for runs on a small dataset.

use std::fs;
use std::ops::Deref;
use std::path::Path;

use super::command::Folder;
use super::sets::small_set;

/// A folder with a dataset of nine small views in `set`, and runs next to it.
pub(crate) struct Workspace(Folder);

impl Deref for Workspace {
    type Target = Folder;

    fn deref(&self) -> &Folder {
        &self.0
    }
}

impl Workspace {
    pub(crate) fn new() -> Self {
        let folder = Folder::empty();
        nightsplat_synth::write(folder.path("set"), &small_set(9, [40, 30], 2)).unwrap();
        Self(folder)
    }

    /// The arguments for training on `set` into `name`.
    pub(crate) fn train(&self, name: &str, options: &str) -> String {
        let settings = "--curve ap3 --model plain --sh-degree 1 --plan none";
        self.named(&format!("train @set --out @{name} {settings} {options}"))
    }

    /// The standard output of that training.
    pub(crate) fn trained(&self, name: &str, options: &str) -> String {
        self.succeed(&self.train(name, options))
    }
}

/// The log of a run without the column of times.
pub(crate) fn log(run: &Path) -> Vec<String> {
    let text = fs::read_to_string(run.join("train.csv")).unwrap();
    text.lines().map(|line| line.rsplit_once(',').unwrap().0.to_owned()).collect()
}
