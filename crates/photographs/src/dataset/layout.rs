//! The location of a dataset's listing: in the given folder, above it, or in an archive.

use std::path::{Path, PathBuf};

use nightsplat_core::{Error, Result, input};

use super::block::Block;
use super::{Split, colmap, transforms};
use crate::image::files::{is_hidden, photographs_in};
use crate::tree;

/// A dataset's folder and the listing of its photographs.
#[derive(Clone, Debug)]
pub(super) struct DatasetLayout {
    /// The folder that paths are relative to.
    pub(super) root: PathBuf,
    /// The COLMAP model that the user named, if any.
    named: Option<PathBuf>,
    /// The part of the dataset that the user named, if any.
    pub(super) block: Option<Block>,
}

/// Folders of COLMAP models below a dataset's root, most likely first; a folder may contain several in subfolders. The
/// root itself may be a model, as in exports of some tools; `distorted` is written by the converter of 3DGS.
const MODEL_FOLDERS: [&str; 8] = [
    "sparse",
    "colmap_sparse",
    "derived_colmap/sparse",
    "colmap/sparse",
    "colmap_text",
    "distorted/sparse",
    "",
    "undistorted/sparse",
];
/// How far above a model its photographs may be: `distorted/sparse/0`.
const MOST_ABOVE: usize = 3;

impl DatasetLayout {
    /// The layout of the whole dataset, without a block.
    pub(super) fn whole(&self) -> Self {
        Self { block: None, ..self.clone() }
    }

    /// The layout of a path that a user gives: a dataset's folder or archive, its transforms file, its COLMAP model, or
    /// a block of it.
    pub(super) fn detect(given: &Path) -> Result<Self> {
        tree::check(given).map_err(|error| input::unreadable(given, &error))?;
        if let Some(block) = Block::at(given)? {
            let layout = Self::detect(&block.dataset)?;
            return Ok(Self { block: Some(block), ..layout });
        }
        let ending = given.extension().unwrap_or_default().to_ascii_lowercase();
        if tree::is_file(given) && ending == "json" {
            let root = given.parent().unwrap_or(Path::new(".")).to_owned();
            return Ok(Self { root, named: None, block: None });
        }
        if !tree::is_dir(given) {
            let problem = if tree::is_file(given) {
                "is a file, not a folder; of a clip `nightsplat pose` makes a dataset"
            } else {
                "is not a folder; name the dataset's folder"
            };
            return Err(Error::input(given, problem));
        }
        let layout = Self { root: given.to_owned(), named: None, block: None };
        if layout.has_listing() {
            return Ok(layout.above_model().unwrap_or(layout));
        }
        // An archive often contains a single folder, which is the dataset.
        if tree::archive_of(given) == Some(given)
            && let [only] = folders_in(given).as_slice()
        {
            return Self::detect(only);
        }
        Ok(layout.above_model().unwrap_or(layout))
    }

    /// The files of a NeRF-style listing with their splits.
    pub(super) fn listings(&self) -> Vec<(PathBuf, Option<Split>)> {
        if self.named.is_some() { vec![] } else { transforms::find(&self.root) }
    }

    /// The COLMAP models that have all `needed` files, from the first location with any, by name.
    pub(super) fn models(&self, needed: &[&str]) -> Vec<PathBuf> {
        if let Some(folder) = &self.named {
            return colmap::models_in(folder, needed);
        }
        let candidates = MODEL_FOLDERS.iter().map(|folder| match *folder {
            "" => colmap::model_in(&self.root, needed).into_iter().collect(),
            folder => colmap::models_in(&self.root.join(folder), needed),
        });
        let mut candidates = candidates.filter(|models: &Vec<PathBuf>| !models.is_empty());
        candidates.next().unwrap_or_else(|| {
            // A folder of any name; one that also contains photographs is a separate dataset.
            let bare = folders_in(&self.root).into_iter().filter(|folder| !has_photographs(folder));
            bare.filter_map(|folder| colmap::model_in(&folder, needed)).collect()
        })
    }

    /// Whether photographs are listed with cameras.
    pub(super) fn has_listing(&self) -> bool {
        !self.listings().is_empty() || !self.models(&CAMERAS).is_empty()
    }

    /// The layout of the dataset around a model that was named.
    fn above_model(&self) -> Option<Self> {
        let given = &self.root;
        let folders = folders_in(given);
        let is_model = |folder: &Path| colmap::model_in(folder, &CAMERAS).is_some();
        let holds_models = !folders.is_empty() && folders.iter().all(|folder| is_model(folder));
        let is_named = self.listings().is_empty() && (is_model(given) || holds_models);
        if !is_named || has_photographs(given) {
            return None;
        }
        let given = given.canonicalize().unwrap_or_else(|_| given.clone());
        let mut above = given.ancestors().skip(1).take(MOST_ABOVE);
        let root = above.find(|folder| has_photographs(folder))?.to_owned();
        Some(Self { root, named: Some(given), block: None })
    }

    /// What was found instead of a dataset, with the remedy.
    pub(super) fn no_dataset(&self) -> String {
        let root = &self.root;
        let expected = "transforms_train.json, transforms.json or a COLMAP model in sparse/0";
        if let Some(dataset) = dataset_of_run(root) {
            return format!(
                "is a run, not a dataset; the dataset that it was trained on is {dataset}"
            );
        }
        if let Some(below) = self.below() {
            return format!("holds no dataset, but {} does: name that", below.display());
        }
        let beside = root.canonicalize().ok().and_then(|root| {
            let above = Self { root: root.parent()?.to_owned(), named: None, block: None };
            above.has_listing().then_some(above.root)
        });
        if let Some(above) = beside {
            return format!("holds no dataset, but its parent {} does: name that", above.display());
        }
        match photographs_in(root).map_or(0, |photographs| photographs.len()) {
            0 => format!("holds no dataset; expected {expected}"),
            count => format!(
                "holds no dataset but {count} photographs, whose poses are not known; `nightsplat {0}` finds them and \
                 trains, `nightsplat pose {0} --out DATASET` finds them alone (expected {expected})",
                root.display()
            ),
        }
    }

    /// A dataset in a subfolder, at most two levels deep.
    fn below(&self) -> Option<PathBuf> {
        let first = folders_in(&self.root);
        let second: Vec<PathBuf> = first.iter().flat_map(|folder| folders_in(folder)).collect();
        let mut below =
            first.into_iter().chain(second).map(|root| Self { root, named: None, block: None });
        below.find(Self::has_listing).map(|layout| layout.root)
    }
}

/// The dataset that a run directory names; `None` of a folder that is none.
fn dataset_of_run(folder: &Path) -> Option<String> {
    let config = std::fs::read_to_string(folder.join("config.toml")).ok()?;
    let table: toml::Table = config.parse().ok()?;
    let is_run = ["steps", "seed", "tone"].iter().all(|key| table.contains_key(*key));
    table.get("dataset").and_then(toml::Value::as_str).filter(|_| is_run).map(str::to_owned)
}

/// The files that a model needs to list photographs with cameras.
pub(super) const CAMERAS: [&str; 2] = ["cameras", "images"];

/// The visible subfolders of a folder, by name.
fn folders_in(folder: &Path) -> Vec<PathBuf> {
    let mut folders = tree::entries(folder).unwrap_or_default();
    folders.retain(|path| !is_hidden(path) && tree::is_dir(path));
    folders.sort();
    folders
}

/// Whether there are photographs in a folder or in one of its subfolders.
fn has_photographs(folder: &Path) -> bool {
    let directly = |folder: &Path| photographs_in(folder).is_ok_and(|paths| !paths.is_empty());
    directly(folder) || folders_in(folder).iter().any(|folder| directly(folder))
}
