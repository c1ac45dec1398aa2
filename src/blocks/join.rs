//! Joins the blocks: of each, the Gaussians whose mean is in its core. One block at a time is in memory, and the blocks
//! are taken in the order of the plan: neither who trained them nor when enters.

use std::collections::BTreeSet;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use nightsplat_core::{hash, input, output};
use nightsplat_models::export::{Format, Provenance};
use nightsplat_models::gaussians::{Gaussians, ply};
use nightsplat_models::joined::{MANIFEST, ModelTile, TileManifest, VERSION};
use nightsplat_photographs::dataset::block::{Block, Cell};
use sha2::{Digest, Sha256};

use super::folder::{model_of, task_folder};
use super::plan::PlanFile;
use crate::results::models;
use crate::results::run::{self, RunDirectory, TRAINED_WITH};
use crate::{Error, Result};

/// The folder of the tiles, beside the manifest.
const TILES: &str = "0";

/// The end of a join.
#[derive(Clone, Debug)]
pub(crate) struct Joined {
    pub(crate) manifest: TileManifest,
    /// Gaussians of the blocks outside their cores, which are left out.
    pub(crate) cropped: usize,
}

/// Joins the blocks of a round of the plan in a folder, by default of the last. With `same_device`, blocks of several
/// devices are refused; else they are recorded. `observe` is called with every tile that is written.
pub(crate) fn join(
    folder: &Path,
    round: Option<u8>,
    same_device: bool,
    mut observe: impl FnMut(&ModelTile),
) -> Result<Joined> {
    let plan = PlanFile::load(folder)?;
    let last = plan.rounds();
    let round = round.unwrap_or(last);
    if !(1..=last).contains(&round) {
        return Err(Error::input(folder, format!("has no round {round}; its last is {last}")));
    }
    let _lock = RunDirectory::lock(folder)?;
    plan.check_photographs(&run::load_config(folder)?)?;
    let blocks = plan.round(round).map(|row| checked(folder, &row.id, &plan.checksum));
    let blocks = blocks.collect::<Result<Vec<Block>>>()?;
    let devices = devices(folder, &blocks, same_device)?;
    let model = folder.join(model_of(round, last));
    output::create_folder(&model.join(TILES))?;
    withdraw(&model.join(MANIFEST))?;
    let mut tiles = vec![];
    let (mut cropped, mut origin) = (0, [0.0; 3]);
    for block in &blocks {
        let (tile, left_out, tile_origin) = write_tile(folder, &model, block)?;
        observe(&tile);
        tiles.push(tile);
        cropped += left_out;
        origin = tile_origin;
    }
    let count = tiles.iter().map(|tile| tile.count).sum();
    let manifest = TileManifest {
        version: VERSION,
        plan: plan.checksum.clone(),
        origin,
        count,
        devices,
        tiles,
        folder: model.clone(),
    };
    if round == last {
        save_metrics(folder, &plan, &manifest)?;
    }
    let text =
        serde_json::to_string_pretty(&manifest).map_err(|error| Error::Usage(error.to_string()))?;
    output::write_whole(&model.join(MANIFEST), (text + "\n").as_bytes())?;
    Ok(Joined { manifest, cropped })
}

/// Removes the manifest of an earlier join: it states what the tiles are, which are about to be replaced one by one.
fn withdraw(manifest: &Path) -> Result<()> {
    match std::fs::remove_file(manifest) {
        Err(error) if error.kind() != ErrorKind::NotFound => {
            Err(Error::output(manifest, format!("cannot be replaced: {error}")))
        }
        _ => Ok(()),
    }
}

/// A block that is done.
fn checked(folder: &Path, id: &str, plan: &str) -> Result<Block> {
    let task = folder.join(task_folder(id));
    let missing = || Error::input(&task, "is missing; plan anew, or copy it here");
    let block = Block::at(&task)?.ok_or_else(missing)?;
    if block.plan != plan {
        let problem = format!("is a block of another plan ({}, not {plan}); plan anew", block.plan);
        return Err(Error::input(&task, problem));
    }
    let run = task.join("run");
    if !run.join("done.json").is_file() {
        let problem = format!(
            "block {id} is not done; `nightsplat blocks run {}` trains it",
            folder.display()
        );
        return Err(Error::input(&run, problem));
    }
    Ok(block)
}

/// The run of a block.
fn run_of(folder: &Path, id: &str) -> PathBuf {
    folder.join(task_folder(id)).join("run")
}

/// The devices on which the blocks were trained, ascending.
fn devices(folder: &Path, blocks: &[Block], same_device: bool) -> Result<Vec<String>> {
    let device = |block: &Block| {
        let run = run_of(folder, &block.id);
        let with = &run::load_metrics(&run)[TRAINED_WITH];
        let text = |key: &str| with[key].as_str().unwrap_or("unknown").to_owned();
        format!("{}, {}", text("device"), text("driver"))
    };
    let devices: BTreeSet<String> = blocks.iter().map(device).collect();
    let devices: Vec<String> = devices.into_iter().collect();
    if devices.len() > 1 {
        let names = devices.join("; ");
        if same_device {
            let problem = format!(
                "has blocks of several devices ({names}); train them on one, or join without --same-device"
            );
            return Err(Error::input(folder, problem));
        }
        tracing::warn!(
            "{}: blocks of several devices, whose bits may differ: {names}",
            folder.display()
        );
    }
    Ok(devices)
}

/// Writes the tile of a block; also returns the number of Gaussians left out, and the origin of its positions.
fn write_tile(folder: &Path, model: &Path, block: &Block) -> Result<(ModelTile, usize, [f64; 3])> {
    let id = &block.id;
    let (mut gaussians, facts) = models::read(&run_of(folder, id))?;
    let before = gaussians.count;
    let inside: Vec<bool> =
        (0..before).map(|index| block.core.contains(gaussians.position(index))).collect();
    gaussians.retain(&inside);
    // Without the number of the round.
    let name = id.split('-').next().unwrap_or(id);
    let file = Path::new(TILES).join(format!("{name}.ply"));
    let path = model.join(&file);
    let origin = gaussians.origin.to_array();
    let provenance = Provenance { facts, ..Provenance::default() };
    Format::Ply.write(&gaussians, &provenance, &path)?;
    let kept = gaussians.count;
    drop(gaussians);
    // What is on the disk is checked, not what is in memory.
    let bytes = input::bytes(&path)?;
    let (written, _) = ply::parse(&bytes).map_err(|problem| Error::output(&path, problem))?;
    let is_whole = written.count == kept
        && (0..written.count).all(|index| block.core.contains(written.position(index)));
    if !is_whole {
        return Err(Error::output(&path, "was not written as a tile of its core; check the disk"));
    }
    let sha256 = hash::hexadecimal(&Sha256::digest(&bytes));
    let bounds = bounds(&written);
    let tile = ModelTile { id: name.to_owned(), file, count: written.count, bounds, sha256 };
    Ok((tile, before - written.count, origin))
}

/// The box of the means; `None` without Gaussians.
fn bounds(gaussians: &Gaussians) -> Option<Cell> {
    let mut positions = (0..gaussians.count).map(|index| gaussians.position(index));
    let first = positions.next()?;
    let (from, to) = positions
        .fold((first, first), |(from, to), position| (from.min(position), to.max(position)));
    Some(Cell { from: from.to_array(), to: to.to_array() })
}

/// The numbers that `eval` and others print of a run.
fn save_metrics(folder: &Path, plan: &PlanFile, manifest: &TileManifest) -> Result<()> {
    let steps: u64 = plan.blocks.iter().map(|row| row.steps).sum();
    let seconds = plan
        .blocks
        .iter()
        .map(|row| run::load_metrics(&run_of(folder, &row.id))["seconds"].as_f64());
    let metrics = serde_json::json!({
        "steps": steps + plan.coarse.steps,
        "seconds": seconds.sum::<Option<f64>>(),
        "gaussians": manifest.count,
    });
    output::write_whole(&folder.join("metrics.json"), format!("{metrics:#}\n").as_bytes())
}
