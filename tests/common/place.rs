//! A folder for runs on a small dataset.

use std::fs;
use std::path::PathBuf;

use nightsplat::photographs::dataset::synthetic::{self, SyntheticOptions};

/// A folder with a dataset of nine small views in `set`, and runs next to it.
pub(crate) struct Place(pub(crate) tempfile::TempDir);

impl Place {
    pub(crate) fn new() -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        let options = SyntheticOptions {
            views: 9,
            width: 40,
            height: 30,
            seed: 2,
            ..SyntheticOptions::default()
        };
        synthetic::write(place.path("set"), &options).unwrap();
        place
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
