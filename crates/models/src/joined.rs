//! A model in tiles: `manifest.json` lists the files, `0/0007.ply` is the tile of block 0007. The tiles are disjoint,
//! and together they are the model.

use std::path::{Path, PathBuf};

use nightsplat_core::input;
use nightsplat_core::{Error, Result};
use nightsplat_photographs::dataset::block::Cell;
use serde::{Deserialize, Serialize};

use crate::gaussians::{Gaussians, ply};

/// The file that lists the tiles.
pub const MANIFEST: &str = "manifest.json";
/// The folder of the joined model in that of a scene.
pub const MODEL: &str = "model";

/// The version of manifests.
pub const VERSION: u32 = 1;

/// The tiles of a model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TileManifest {
    /// [`VERSION`].
    pub version: u32,
    /// The checksum of the plan of blocks.
    pub plan: String,
    /// The origin of the positions in the tiles, in the dataset's world.
    pub origin: [f64; 3],
    /// The number of Gaussians.
    pub count: usize,
    /// The devices on which the blocks were trained, by name and driver.
    pub devices: Vec<String>,
    /// In the order of the blocks.
    pub tiles: Vec<ModelTile>,
    /// The folder that it was read from.
    #[serde(skip)]
    pub folder: PathBuf,
}

/// A file of a model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelTile {
    /// The name of its block.
    pub id: String,
    /// The file, relative to the manifest's folder.
    pub file: PathBuf,
    /// The number of Gaussians.
    pub count: usize,
    /// Corners of the box of the means, in the dataset's world; empty tiles have none.
    pub bounds: Option<Cell>,
    /// Of the file.
    pub sha256: String,
}

impl TileManifest {
    /// The manifest of the model of a scene; `None` if it is not in tiles.
    pub fn of_scene(folder: &Path) -> Result<Option<Self>> {
        let model = folder.join(MODEL);
        if model.join(MANIFEST).is_file() { Self::load(&model).map(Some) } else { Ok(None) }
    }

    /// The manifest in a folder.
    pub fn load(folder: &Path) -> Result<Self> {
        let path = folder.join(MANIFEST);
        let wrong =
            |problem: String| Error::input(&path, format!("{problem}; join the blocks anew"));
        let mut manifest: Self = serde_json::from_str(&input::text(&path)?)
            .map_err(|error| wrong(format!("is not a manifest: {error}")))?;
        if manifest.version != VERSION {
            let version = manifest.version;
            return Err(wrong(format!("has version {version}, this program reads {VERSION}")));
        }
        folder.clone_into(&mut manifest.folder);
        Ok(manifest)
    }

    /// The files of the tiles.
    pub fn files(&self) -> Vec<PathBuf> {
        self.tiles.iter().map(|tile| self.folder.join(&tile.file)).collect()
    }

    /// The numbers of Gaussians of the tiles.
    pub fn counts(&self) -> Vec<usize> {
        self.tiles.iter().map(|tile| tile.count).collect()
    }

    /// The whole model.
    pub fn gaussians(&self) -> Result<Gaussians> {
        let mut whole: Option<Gaussians> = None;
        for tile in &self.tiles {
            Gaussians::add(&mut whole, self.read(tile)?);
        }
        let problem = "has no Gaussians; join the blocks anew";
        whole.ok_or_else(|| Error::input(self.folder.join(MANIFEST), problem))
    }

    /// Reads a tile.
    pub fn read(&self, tile: &ModelTile) -> Result<Gaussians> {
        let path = self.folder.join(&tile.file);
        let gaussians = ply::load(&path)?;
        if gaussians.count == tile.count {
            return Ok(gaussians);
        }
        let problem = format!(
            "has {} Gaussians, the manifest states {}; join the blocks anew",
            gaussians.count, tile.count
        );
        Err(Error::input(&path, problem))
    }
}
