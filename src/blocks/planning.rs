//! Plans the blocks of a scene: measures once what all of them share, and decides where they end and what they see.

use std::path::{Path, PathBuf};

use nightsplat_core::hash::{self, Hasher};
use nightsplat_photographs::dataset::Dataset;
use nightsplat_photographs::scene_tone::SceneTone;

use super::budget::Budget;
use super::draft::{Draft, block_id};
use super::plan::{BlockPlan, LAW, PlanFile, Request, VERSION};
use crate::train::{PlannedRun, StopConfig, TrainConfig};
use crate::{Error, Result};
use nightsplat_photographs::dataset::block::partition::{
    BlockCells, Until, WeightedPoint, partition,
};
use nightsplat_photographs::dataset::block::visibility::Visibility;

/// Blocks whose mean share of the views is larger do not pay.
const MOST_SHARED: f64 = 0.75;
/// The fewest views of a block.
const LEAST_VIEWS: usize = 3;

/// Plans the blocks of a dataset. Nothing is written.
pub(crate) fn plan(planned: &PlannedRun, request: &Request) -> Result<BlockPlan> {
    let PlannedRun { config, dataset, .. } = planned;
    let mut config = config.clone();
    let root = &dataset.root;
    if dataset.points.is_empty() {
        let problem =
            "has no points, by which a scene is divided; find them with `nightsplat pose`";
        return Err(Error::input(root, problem));
    }
    let visibility = Visibility::new(dataset);
    let budget = Budget::new(&config, dataset, request.is_shared);
    let parts = parts(dataset, &visibility, &config, &budget, request)?;
    let serving = visibility.serving(&parts);
    let shared = mean_share(&serving, visibility.training.len());
    check_views(root, &serving, shared)?;
    let law = SceneTone::measure_all(&config.tone, dataset)?;
    settle(&mut config, dataset);
    let stamp = Dataset::stamp(root, &config.load_options())?;
    let thinned = visibility.thinned();
    let draft =
        Draft { dataset, visibility: &visibility, config: &config, budget, request, thinned };
    let mut file = PlanFile {
        version: VERSION,
        checksum: String::new(),
        stamp,
        settings: config.checksum()?,
        memory: request.memory,
        coarse: draft.coarse(),
        blocks: draft.rows(&parts, &serving),
    };
    file.checksum = checksum(&file, &parts)?;
    let blocks = draft.blocks(&file, &parts, &serving);
    Ok(BlockPlan { file, shared, config, law, blocks })
}

/// The parts of the scene, of as much weight each as the memory allows.
fn parts(
    dataset: &Dataset,
    visibility: &Visibility<'_>,
    config: &TrainConfig,
    budget: &Budget,
    request: &Request,
) -> Result<Vec<BlockCells>> {
    let shares = visibility.pixel_shares();
    let weighted = dataset.points.iter().zip(shares);
    let weighted: Vec<WeightedPoint> = weighted
        .map(|(point, share)| WeightedPoint { position: point.position, weight: 1.0 + share })
        .collect();
    let most = budget.gaussians(request.memory as f64) / config.max_gaussians as f64;
    let until = match request.blocks {
        Some(count) => Until::Count(count),
        None if most <= 0.0 => {
            let (memory, least) =
                (request.memory >> 20, budget.memory(0.0, 1.0, request.memory as f64) as u64 >> 20);
            let problem = format!(
                "a worker with {memory} MiB trains nothing: {least} MiB are taken before the first \
                                   Gaussian; raise --memory or lower --cache"
            );
            return Err(Error::Usage(problem));
        }
        None => Until::Share(most),
    };
    let parts = partition(&weighted, visibility.up, until).ok_or_else(|| {
        Error::input(
            &dataset.root,
            "cannot be divided further: its points are at one place; ask for fewer blocks",
        )
    })?;
    if parts.len() == 1 {
        let problem = format!(
            "fits as a whole: {} Gaussians need {} MiB; train it with `nightsplat train`",
            config.max_gaussians,
            budget.memory(
                config.max_gaussians as f64,
                visibility.training.len() as f64,
                request.memory as f64
            ) as u64
                >> 20
        );
        return Err(Error::input(&dataset.root, problem));
    }
    Ok(parts)
}

fn mean_share(serving: &[Vec<usize>], views: usize) -> f64 {
    let sum: usize = serving.iter().map(Vec::len).sum();
    sum as f64 / (serving.len() * views).max(1) as f64
}

fn check_views(root: &Path, serving: &[Vec<usize>], shared: f64) -> Result<()> {
    if shared > MOST_SHARED {
        let percent = 100.0 * shared;
        let problem = format!(
            "is seen as a whole by most views: a block would need {percent:.0} % of them on average (at most 75 %), so \
             blocks train the same scene several times; train it with `nightsplat train`, or ask for fewer blocks"
        );
        return Err(Error::input(root, problem));
    }
    match serving.iter().position(|views| views.len() < LEAST_VIEWS) {
        None => Ok(()),
        Some(block) => {
            let (id, count) = (block_id(block), serving[block].len());
            let problem = format!(
                "block {id} is seen by {count} views, fewer than {LEAST_VIEWS}; ask for fewer blocks"
            );
            Err(Error::input(root, problem))
        }
    }
}

/// Records what is measured once: the law, the frame, the extent and the up direction.
fn settle(config: &mut TrainConfig, dataset: &Dataset) {
    config.frame.get_or_insert_with(|| dataset.frame());
    config.extent.get_or_insert_with(|| dataset.extent());
    config.up.get_or_insert_with(|| dataset.up().to_array());
    config.tone.law = Some(PathBuf::from(LAW));
    // A block runs for a fixed number of steps, on all its views.
    config.stop = StopConfig { views: 0, ..config.stop.clone() };
    if config.exposure.learn {
        tracing::warn!(
            "exposures of views are not learned in blocks, in which they could drift apart; the tone law keeps them"
        );
        config.exposure.learn = false;
    }
    if config.model.lamp {
        tracing::warn!(
            "a lamp at the camera is not learned in blocks, which would find one each; the surfaces keep its light"
        );
        config.model.lamp = false;
    }
}

/// The checksum of a plan's numbers and cells.
fn checksum(file: &PlanFile, parts: &[BlockCells]) -> Result<String> {
    let text = toml::to_string(file).map_err(|error| Error::Usage(error.to_string()))?;
    let mut hasher = Hasher::default();
    hasher.write(text.as_bytes());
    for cell in parts.iter().flat_map(|part| [part.core, part.halo]) {
        hasher.write_numbers(&cell.from);
        hasher.write_numbers(&cell.to);
    }
    Ok(hash::text(hasher.finish()))
}
