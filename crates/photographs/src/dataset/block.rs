//! A part of a dataset that is trained by itself: `block.toml` names the dataset, and which of its views and points
//! belong to the block. The photographs stay where they are.

pub mod partition;
pub mod visibility;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use glam::DVec3;
use nightsplat_core::{Error, Result, output};
use serde::{Deserialize, Serialize};

use super::Point;
use super::listed::ViewEntry;
use crate::tree;

/// The file of a block.
pub const BLOCK: &str = "block.toml";

/// The file of the indices of a block's points, 32-bit little-endian.
const POINTS: &str = "points.u32";

const VERSION: u32 = 1;

/// A box of the world: from the first corner, which it contains, to the second, which it does not.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cell {
    /// The corner with the least coordinates.
    pub from: [f64; 3],
    /// The corner with the greatest coordinates.
    pub to: [f64; 3],
}

impl Cell {
    /// All of the world.
    pub const WORLD: Self = Self { from: [f64::NEG_INFINITY; 3], to: [f64::INFINITY; 3] };

    /// Whether it shares positions with another.
    pub fn overlaps(&self, other: &Self) -> bool {
        (0..3).all(|axis| self.from[axis] < other.to[axis] && other.from[axis] < self.to[axis])
    }

    /// Whether a position is in it.
    pub fn contains(&self, position: DVec3) -> bool {
        let position = position.to_array();
        (0..3).all(|axis| (self.from[axis]..self.to[axis]).contains(&position[axis]))
    }
}

/// A part of a dataset.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Block {
    version: u32,
    /// Its name in its plan.
    pub id: String,
    /// The checksum of its plan.
    pub plan: String,
    /// The dataset; in the file relative to the block's folder.
    pub dataset: PathBuf,
    /// What its model is responsible for. The cells of a plan's blocks fill the world without overlaps.
    pub core: Cell,
    /// The core and its surroundings, in which its Gaussians are trained.
    pub halo: Cell,
    /// The blocks whose halos overlap its own.
    pub neighbours: Vec<String>,
    /// The names of its views, ascending.
    pub views: Vec<String>,
    /// Ascending indices into the dataset's points.
    #[serde(skip)]
    pub points: Vec<u32>,
}

impl Block {
    /// A block of a plan.
    pub fn new(id: &str, plan: &str, dataset: PathBuf, [core, halo]: [Cell; 2]) -> Self {
        Self {
            version: VERSION,
            id: id.to_owned(),
            plan: plan.to_owned(),
            dataset,
            core,
            halo,
            neighbours: vec![],
            views: vec![],
            points: vec![],
        }
    }

    /// The block in a folder; `None` if it contains none.
    pub fn at(folder: &Path) -> Result<Option<Self>> {
        let path = folder.join(BLOCK);
        if !tree::is_file(&path) {
            return Ok(None);
        }
        let wrong = |problem: &str| Error::input(&path, format!("is not a block: {problem}"));
        let mut block: Self =
            toml::from_str(&tree::text(&path)?).map_err(|error| wrong(error.message()))?;
        if block.version != VERSION {
            let version = block.version;
            return Err(wrong(&format!(
                "its version is {version}, this program reads {VERSION}; plan anew"
            )));
        }
        block.dataset = folder.join(&block.dataset);
        if tree::is_file(&block.dataset.join(BLOCK)) {
            return Err(wrong("its dataset is a block itself"));
        }
        let bytes = tree::bytes(&folder.join(POINTS))?;
        let (points, rest) = bytes.as_chunks::<4>();
        if !rest.is_empty() {
            return Err(Error::input(folder.join(POINTS), "is cut off; plan anew"));
        }
        block.points = points.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect();
        Ok(Some(block))
    }

    /// Writes the block into an existing folder.
    pub fn save(&self, folder: &Path) -> Result<()> {
        let points: Vec<u8> = self.points.iter().flat_map(|point| point.to_le_bytes()).collect();
        output::write_whole(&folder.join(POINTS), &points)?;
        let text = toml::to_string(self).map_err(|error| Error::Usage(error.to_string()))?;
        output::write_whole(&folder.join(BLOCK), text.as_bytes())
    }

    /// Keeps the views of the block, with their splits in the dataset.
    pub(super) fn restrict(&self, frames: &mut Vec<ViewEntry>) -> Result<()> {
        let wanted: BTreeSet<&str> = self.views.iter().map(String::as_str).collect();
        frames.retain(|frame| wanted.contains(frame.name.as_str()));
        if frames.len() == wanted.len() {
            return Ok(());
        }
        let kept: BTreeSet<&str> = frames.iter().map(|frame| frame.name.as_str()).collect();
        let missing = wanted.difference(&kept).next().copied().unwrap_or_default();
        let problem = format!("lacks the view {missing} of block {}; plan anew", self.id);
        Err(Error::input(&self.dataset, problem))
    }

    /// The points of the block, of all points of the dataset.
    pub(super) fn points_of(&self, all: Vec<Point>) -> Result<Vec<Point>> {
        let count = all.len();
        if self.points.last().is_some_and(|last| *last as usize >= count) {
            let problem =
                format!("has {count} points, fewer than for block {}; plan anew", self.id);
            return Err(Error::input(&self.dataset, problem));
        }
        let mut wanted = self.points.iter().peekable();
        let is_wanted = |(index, _): &(u32, Point)| wanted.next_if_eq(&index).is_some();
        Ok((0..).zip(all).filter(is_wanted).map(|(_, point)| point).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_is_read_back_to_the_bit() {
        let folder = tempfile::tempdir().unwrap();
        let mut block =
            Block::new("0007", "abc", PathBuf::from("../photos"), [Cell::WORLD, Cell::WORLD]);
        block.core.to[1] = 0.1 + 0.2;
        block.views = vec!["a".to_owned(), "b \"c\"".to_owned()];
        block.points = vec![0, 3, u32::MAX];
        assert_eq!(Block::at(folder.path()).unwrap(), None);
        block.save(folder.path()).unwrap();
        let read = Block::at(folder.path()).unwrap().unwrap();
        assert_eq!(read.dataset, folder.path().join("../photos"));
        assert_eq!(Block { dataset: block.dataset.clone(), ..read }, block);
    }

    #[test]
    fn neighbouring_cells_share_no_position_and_leave_none_out() {
        let [mut left, mut right] = [Cell::WORLD; 2];
        (left.to[0], right.from[0]) = (0.5, 0.5);
        for x in [f64::MIN, 0.49999, 0.5, 0.50001, f64::MAX] {
            let position = DVec3::new(x, 1e300, -1e300);
            assert_ne!(left.contains(position), right.contains(position), "{x}");
        }
        assert!(!Cell::WORLD.contains(DVec3::NAN));
    }

    #[test]
    fn points_are_those_of_the_indices() {
        let point = |x: f64| Point { position: DVec3::splat(x), views: vec![] };
        let all: Vec<Point> = (0..5).map(f64::from).map(point).collect();
        let mut block = Block::new("0", "", PathBuf::new(), [Cell::WORLD; 2]);
        block.points = vec![1, 4];
        assert_eq!(block.points_of(all.clone()).unwrap(), [point(1.0), point(4.0)]);
        block.points.push(5);
        assert!(block.points_of(all).unwrap_err().to_string().contains("has 5 points"));
    }
}
