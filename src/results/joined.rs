//! A model in tiles: `model/manifest.json` lists the files, `model/0/0007.ply` is the tile of block 0007 at full
//! detail. The tiles of a level are disjoint, and together they are the model.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::base::input;
use crate::photographs::dataset::block::Cell;
use crate::splats::scene::{Gaussians, ply};
use crate::{Error, Result};

/// The file that lists the tiles, relative to the folder of the scene.
pub(crate) const MANIFEST: &str = "model/manifest.json";

pub(crate) const VERSION: u32 = 1;

/// The tiles of a model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Manifest {
    pub(crate) version: u32,
    /// The checksum of the plan of blocks.
    pub(crate) plan: String,
    /// The origin of the positions in the tiles, in the dataset's world.
    pub(crate) origin: [f64; 3],
    /// The number of Gaussians at full detail.
    pub(crate) count: usize,
    /// The devices on which the blocks were trained, by name and driver.
    pub(crate) devices: Vec<String>,
    /// In the order of the blocks, level by level.
    pub(crate) tiles: Vec<Tile>,
}

/// A file of a model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Tile {
    /// The name of its block.
    pub(crate) id: String,
    /// 0: full detail; each further level has half of the Gaussians.
    pub(crate) level: u32,
    /// The file, relative to the scene's folder.
    pub(crate) file: PathBuf,
    pub(crate) count: usize,
    /// Corners of the box of the means, in the dataset's world; empty tiles have none.
    pub(crate) bounds: Option<Cell>,
    /// Of the file.
    pub(crate) sha256: String,
}

impl Manifest {
    /// The manifest in the folder of a scene; `None` if its model is not in tiles.
    ///
    /// # Errors
    /// [`Error::Input`] if it is damaged or of another version.
    pub(crate) fn at(folder: &Path) -> Result<Option<Self>> {
        let path = folder.join(MANIFEST);
        if !path.is_file() {
            return Ok(None);
        }
        let wrong =
            |problem: String| Error::input(&path, format!("{problem}; join the blocks anew"));
        let manifest: Self = serde_json::from_str(&input::text(&path)?)
            .map_err(|error| wrong(format!("is not a manifest: {error}")))?;
        match manifest.version {
            VERSION => Ok(Some(manifest)),
            version => Err(wrong(format!("has version {version}, this program reads {VERSION}"))),
        }
    }

    /// The tiles of a level.
    pub(crate) fn level(&self, level: u32) -> impl Iterator<Item = &Tile> {
        self.tiles.iter().filter(move |tile| tile.level == level)
    }

    /// The whole model at full detail.
    ///
    /// # Errors
    /// A tile is missing or damaged, or has another number of Gaussians.
    pub(crate) fn gaussians(&self, folder: &Path) -> Result<Gaussians> {
        let mut tiles = self.level(0).map(|tile| tile.load(folder));
        let none =
            || Err(Error::input(folder.join(MANIFEST), "lists no tiles; join the blocks anew"));
        let mut gaussians = tiles.next().unwrap_or_else(none)?;
        for tile in tiles {
            let tile = tile?;
            // A block whose run was short may lack the highest degrees.
            let degree = gaussians.shape.sh_degree.max(tile.shape.sh_degree);
            gaussians = gaussians.with_sh_degree(degree);
            gaussians.append(&tile.with_sh_degree(degree));
        }
        Ok(gaussians)
    }
}

impl Tile {
    /// Reads the tile.
    ///
    /// # Errors
    /// As [`Manifest::gaussians`].
    pub(crate) fn load(&self, folder: &Path) -> Result<Gaussians> {
        let path = folder.join(&self.file);
        let gaussians = ply::load(&path)?;
        if gaussians.count == self.count {
            return Ok(gaussians);
        }
        let problem = format!(
            "has {} Gaussians, the manifest states {}; join the blocks anew",
            gaussians.count, self.count
        );
        Err(Error::input(&path, problem))
    }
}
