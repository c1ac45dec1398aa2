//! A folder for runs on a small dataset.

use std::fs;
use std::path::{Path, PathBuf};

use super::train::small_set;

/// A folder with a dataset of nine small views in `set`, and runs next to it.
pub(crate) struct Workspace(pub(crate) tempfile::TempDir);

impl Workspace {
    pub(crate) fn new() -> Self {
        let workspace = Self(tempfile::tempdir().unwrap());
        let options = small_set(9, [40, 30], 2);
        nightsplat_synth::write(workspace.path("set"), &options).unwrap();
        workspace
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// The arguments for training on `set` into `name`.
    pub(crate) fn train(&self, name: &str, options: &str) -> String {
        let (set, out) = (self.path("set"), self.path(name));
        format!(
            "train {} --out {} --curve ap3 --model plain --sh-degree 1 --plan none {options}",
            set.display(),
            out.display()
        )
    }

    pub(crate) fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap()
    }

    pub(crate) fn model(&self, name: &str) -> Vec<u8> {
        self.read(&format!("{name}/model.ply"))
    }
}

/// The log of a run without the column of times.
pub(crate) fn log(run: &Path) -> Vec<String> {
    let text = fs::read_to_string(run.join("train.csv")).unwrap();
    text.lines().map(|line| line.rsplit_once(',').unwrap().0.to_owned()).collect()
}
