//! Streamed SOG: a model in chunks at several levels of detail, and an index with which a viewer loads those that it
//! needs. Source: the specification of the format, version 1.
//!
//! ```text
//! lod-meta.json      a binary tree of boxes; its leaves state where their Gaussians of each level are
//! LEVEL_CHUNK/       a SOG as files, with a level of several leaves
//! ```
//!
//! A leaf is a cell of [`levels`]: its levels are of the same Gaussians, so viewers can take each from another level.
//! Tiles are loaded one at a time; in memory are one tile, and an unfinished chunk of every level. The same tiles give
//! the same bytes.

use std::borrow::Cow;
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec3};
use nightsplat_core::output::{create_folder, write_whole};
use nightsplat_core::{Error, Result};
use rayon::prelude::*;
use serde_json::{Value, json};

use super::{GENERATOR, Provenance, sog};
use crate::gaussians::{Gaussians, ModelFacts};
use crate::levels::{self, Cells};

/// The index, by whose name loaders recognise the format.
pub const INDEX: &str = "lod-meta.json";

/// Leaves of a chunk of level 0.
const LEAVES_PER_CHUNK: usize = 4;

/// The most levels: the coarsest of a cell of the usual size is then one Gaussian.
pub const MAX_LEVELS: usize = 16;

/// A part of a model that is loaded at once.
pub struct TileLoader<'a> {
    /// For messages.
    pub name: PathBuf,
    /// How many Gaussians it has.
    pub count: usize,
    /// Reads them, in the colours that viewers show.
    pub load: Box<dyn Fn() -> Result<Cow<'a, Gaussians>> + 'a>,
}

impl<'a> TileLoader<'a> {
    /// A model as one tile.
    pub fn whole(name: &Path, gaussians: &'a Gaussians) -> Self {
        let load = Box::new(move || Ok(Cow::Borrowed(gaussians)));
        Self { name: name.to_owned(), count: gaussians.count, load }
    }
}

impl std::fmt::Debug for TileLoader<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Tile").field("name", &self.name).field("count", &self.count).finish()
    }
}

/// How a model is divided.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Division {
    /// Levels of detail; `None` for as many as it takes until the coarsest is no larger than a chunk.
    pub levels: Option<usize>,
    /// The most Gaussians of a chunk, at least 1.
    pub chunk: usize,
}

impl Default for Division {
    fn default() -> Self {
        Self { levels: None, chunk: 1 << 17 }
    }
}

impl Division {
    /// The most Gaussians of a cell.
    pub fn cell(self) -> usize {
        (self.chunk / LEAVES_PER_CHUNK).max(1)
    }

    /// The levels of a model of this many Gaussians.
    pub fn levels_of(self, count: usize) -> usize {
        let enough = (1..MAX_LEVELS).find(|levels| count >> (levels - 1) <= self.chunk);
        self.levels.unwrap_or(enough.unwrap_or(MAX_LEVELS)).clamp(1, MAX_LEVELS)
    }
}

/// What is written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Written {
    /// Gaussians of each level.
    pub counts: Vec<usize>,
    /// Chunks of all levels.
    pub chunks: usize,
}

/// Writes the tiles of a model into a folder, in place of an earlier export. The index is written last: without it, the
/// folder is no model.
///
/// # Errors
/// [`Error::Output`] if the folder holds anything else or a file cannot be written, [`Error::Input`] if a tile does not
/// have its count, [`Error::Usage`] if there are no Gaussians; and those of loading a tile.
pub fn write(
    folder: &Path,
    tiles: &[TileLoader<'_>],
    provenance: &Provenance,
    division: Division,
) -> Result<Written> {
    let total: usize = tiles.iter().map(|tile| tile.count).sum();
    if total == 0 {
        return Err(Error::Usage("a model without Gaussians cannot be streamed".to_owned()));
    }
    prepare(folder)?;
    let levels = division.levels_of(total);
    let mut chunks = ChunkWriter::new(folder, provenance, division.chunk, levels);
    let (mut nodes, mut origin) = (vec![], None);
    for tile in tiles.iter().filter(|tile| tile.count > 0) {
        let gaussians = (tile.load)()?;
        if gaussians.count != tile.count {
            let problem = format!("has {} Gaussians, not {}", gaussians.count, tile.count);
            return Err(Error::input(&tile.name, problem));
        }
        let origin = *origin.get_or_insert(gaussians.origin);
        let gaussians = relative_to(gaussians, origin);
        nodes.push(tile_node(&gaussians, division.cell(), &mut chunks)?);
        chunks.finish()?;
    }
    let root = tree_of(nodes).ok_or_else(|| Error::Usage("no tile has Gaussians".to_owned()))?;
    let mut asset = json!({ "generator": GENERATOR, "provenance": provenance.lines() });
    let facts = ModelFacts { origin: origin.unwrap_or_default(), ..provenance.facts.clone() };
    asset["nightsplat"] = facts.json();
    let index = json!({
        "version": 1,
        "asset": asset,
        "count": chunks.counts.iter().sum::<usize>(),
        "counts": chunks.counts,
        "lodLevels": levels,
        "lodErrors": true,
        "filenames": chunks.names,
        "tree": root.json,
    });
    write_whole(&folder.join(INDEX), format!("{index:#}\n").as_bytes())?;
    Ok(Written { counts: chunks.counts, chunks: chunks.names.len() })
}

/// Makes the folder, or removes an earlier export from it.
fn prepare(folder: &Path) -> Result<()> {
    create_folder(folder)?;
    let failed =
        |error: std::io::Error| Error::output(folder, format!("cannot be replaced: {error}"));
    let entries: Vec<_> =
        fs::read_dir(folder).and_then(Iterator::collect::<std::io::Result<_>>).map_err(failed)?;
    let names: Vec<String> =
        entries.iter().map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    let is_index = |name: &str| name.strip_suffix(".partial").unwrap_or(name) == INDEX;
    if let Some(other) = names.iter().find(|name| !is_index(name) && !is_chunk(name)) {
        let problem =
            format!("holds `{other}`, which is no part of a streamed SOG; choose a new folder");
        return Err(Error::output(folder, problem));
    }
    if names.iter().any(|name| name == INDEX) {
        fs::remove_file(folder.join(INDEX)).map_err(failed)?;
    }
    let chunks = names.iter().filter(|name| is_chunk(name));
    chunks.into_iter().try_for_each(|name| fs::remove_dir_all(folder.join(name))).map_err(failed)
}

/// Whether a name is that of a chunk's folder: two numbers.
fn is_chunk(name: &str) -> bool {
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    name.split_once('_').is_some_and(|(level, chunk)| is_number(level) && is_number(chunk))
}

/// The Gaussians with positions relative to another origin.
fn relative_to(mut gaussians: Cow<'_, Gaussians>, origin: DVec3) -> Cow<'_, Gaussians> {
    let offset = gaussians.origin - origin;
    if offset != DVec3::ZERO {
        let moved = gaussians.to_mut();
        moved.origin = origin;
        for mean in moved.means_mut() {
            *mean = (mean.as_dvec3() + offset).as_vec3();
        }
    }
    gaussians
}

/// A box.
#[derive(Clone, Copy)]
struct Bounds {
    min: DVec3,
    max: DVec3,
}

impl Bounds {
    const NONE: Self = Self { min: DVec3::INFINITY, max: DVec3::NEG_INFINITY };

    /// Of ellipsoids of one standard deviation.
    fn new(gaussians: &Gaussians) -> Self {
        (0..gaussians.count).fold(Self::NONE, |bounds, index| {
            let mean = gaussians.means()[index].as_dvec3();
            let [w, x, y, z] = gaussians.quats()[index].map(f64::from);
            let rotation = DQuat::from_xyzw(x, y, z, w);
            let rotation = if rotation.length() > 0.0 { rotation.normalize() } else { rotation };
            let scales = gaussians.log_scales()[index].as_dvec3().exp();
            let axes = DMat3::from_quat(rotation) * DMat3::from_diagonal(scales);
            let squares = axes.x_axis * axes.x_axis + axes.y_axis * axes.y_axis;
            let reach = (squares + axes.z_axis * axes.z_axis).map(f64::sqrt);
            bounds.with(Self { min: mean - reach, max: mean + reach })
        })
    }

    fn with(self, other: Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// With the precision of the format, seven digits.
    fn json(self) -> Value {
        let rounded = |value: f64| format!("{value:.6e}").parse().unwrap_or(value);
        let [min, max] = [self.min, self.max].map(|corner| corner.to_array().map(rounded));
        json!({ "min": min, "max": max })
    }
}

/// A node of the tree.
struct Node {
    bounds: Bounds,
    json: Value,
}

impl Node {
    fn over(first: Self, second: Self) -> Self {
        let bounds = first.bounds.with(second.bounds);
        let json = json!({ "bound": bounds.json(), "children": [first.json, second.json] });
        Self { bounds, json }
    }
}

/// A tree over the trees of tiles: halves along the longest axis.
fn tree_of(mut nodes: Vec<Node>) -> Option<Node> {
    if nodes.len() < 2 {
        return nodes.pop();
    }
    let all = nodes.iter().fold(Bounds::NONE, |bounds, node| bounds.with(node.bounds));
    let axis = (all.max - all.min).max_position();
    let middle = |node: &Node| node.bounds.min[axis] + node.bounds.max[axis];
    nodes.sort_by(|a, b| middle(a).total_cmp(&middle(b)));
    let second = nodes.split_off(nodes.len() / 2);
    Some(Node::over(tree_of(nodes)?, tree_of(second)?))
}

/// The levels of a cell.
struct CellLevels {
    bounds: Bounds,
    levels: Vec<Gaussians>,
    /// How far each is from level 0.
    errors: Vec<f64>,
}

impl CellLevels {
    fn new(cell: Gaussians, count: usize) -> Self {
        let bounds = Bounds::new(&cell);
        let mut leaf = Self { bounds, levels: vec![cell], errors: vec![0.0] };
        for level in 1..count {
            let (next, change) = levels::coarser(&leaf.levels[level - 1]);
            leaf.bounds = leaf.bounds.with(Bounds::new(&next));
            leaf.errors.push(leaf.errors[level - 1] + change);
            leaf.levels.push(next);
        }
        leaf
    }
}

/// Writes the chunks of a tile's cells, and returns its tree.
fn tile_node(gaussians: &Gaussians, most: usize, chunks: &mut ChunkWriter<'_>) -> Result<Node> {
    let Cells { order, cells } = Cells::new(gaussians.means(), most);
    let levels = chunks.pending.len();
    let leaf =
        |cell: &Range<usize>| CellLevels::new(gaussians.select(&order[cell.clone()]), levels);
    let mut nodes = Vec::with_capacity(cells.len());
    // As many at once as there are threads: their levels are in memory.
    for some in cells.chunks(rayon::current_num_threads()) {
        let leaves: Vec<CellLevels> = some.par_iter().map(leaf).collect();
        for CellLevels { bounds, levels, errors } in leaves {
            let lods = chunks.add(levels)?;
            let errors: Vec<f64> =
                errors.into_iter().map(|error| f64::from(error as f32)).collect();
            let json = json!({ "bound": bounds.json(), "lods": lods, "errors": errors });
            nodes.push(Node { bounds, json });
        }
    }
    Ok(nested(gaussians.count, most, &mut nodes.into_iter()))
}

/// The tree over the leaves of a node of this many Gaussians, as [`Cells`] divides it.
fn nested(count: usize, most: usize, leaves: &mut impl Iterator<Item = Node>) -> Node {
    if count <= most {
        let none = || Node { bounds: Bounds::NONE, json: Value::Null };
        return leaves.next().unwrap_or_else(none);
    }
    let first = levels::first_half(count);
    let first_node = nested(first, most, leaves);
    Node::over(first_node, nested(count - first, most, leaves))
}

/// The chunks of all levels.
struct ChunkWriter<'a> {
    folder: &'a Path,
    provenance: &'a Provenance,
    most: usize,
    /// The unfinished chunk of each level.
    pending: Vec<Pending>,
    names: Vec<String>,
    counts: Vec<usize>,
}

/// A chunk that more cells may be added to.
#[derive(Default)]
struct Pending {
    /// Chunks of its level before it.
    number: usize,
    /// Its index in the list of files.
    file: usize,
    cells: Vec<Gaussians>,
    count: usize,
}

impl<'a> ChunkWriter<'a> {
    fn new(folder: &'a Path, provenance: &'a Provenance, most: usize, levels: usize) -> Self {
        let pending = (0..levels).map(|_| Pending::default()).collect();
        Self { folder, provenance, most, pending, names: vec![], counts: vec![0; levels] }
    }

    /// Adds the levels of a leaf, and returns where they are.
    fn add(&mut self, levels: Vec<Gaussians>) -> Result<Value> {
        let mut lods = serde_json::Map::new();
        for (level, cell) in levels.into_iter().enumerate() {
            if self.pending[level].count + cell.count > self.most {
                self.flush(level)?;
            }
            let pending = &mut self.pending[level];
            if pending.cells.is_empty() {
                pending.file = self.names.len();
                self.names.push(format!("{level}_{}/{}", pending.number, sog::META));
            }
            let range =
                json!({ "file": pending.file, "offset": pending.count, "count": cell.count });
            lods.insert(level.to_string(), range);
            pending.count += cell.count;
            self.counts[level] += cell.count;
            pending.cells.push(cell);
        }
        Ok(lods.into())
    }

    fn flush(&mut self, level: usize) -> Result<()> {
        let Pending { number, cells, count, .. } = &mut self.pending[level];
        if cells.is_empty() {
            return Ok(());
        }
        let folder = self.folder.join(format!("{level}_{number}"));
        let cells = std::mem::take(cells);
        (*number, *count) = (*number + 1, 0);
        let counts: Vec<usize> = cells.iter().map(|cell| cell.count).collect();
        let chunk = Gaussians::concatenated(&cells.iter().collect::<Vec<_>>());
        drop(cells);
        sog::write_folder(&folder, &chunk, self.provenance, &counts)
    }

    /// Writes all unfinished chunks.
    fn finish(&mut self) -> Result<()> {
        (0..self.pending.len()).try_for_each(|level| self.flush(level))
    }
}
