//! The plan of a scene that is trained in blocks: what is measured once for all of them, and the task of each.

use std::path::Path;

use nightsplat_core::input;
use nightsplat_photographs::dataset::Dataset;
use nightsplat_photographs::dataset::block::Block;
use nightsplat_photographs::scene_tone::SceneTone;
use serde::{Deserialize, Serialize};

use crate::train::TrainConfig;
use crate::{Error, Result};

/// The file of the plan's numbers.
pub(super) const PLAN: &str = "plan.toml";
/// The file of the tone law.
pub(crate) const LAW: &str = "law.toml";
/// The folder of the coarse model.
pub(crate) const COARSE: &str = "coarse";
/// The folder of the blocks.
pub(crate) const BLOCKS: &str = "blocks";

pub(super) const VERSION: u32 = 1;
/// The most rounds.
pub(crate) const MAX_ROUNDS: u8 = 3;

/// What the user asks for, beside the settings of a training.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Request {
    /// Memory of a worker, bytes.
    pub(crate) memory: u64,
    /// Whether the device's memory is that of the host.
    pub(crate) is_shared: bool,
    /// The number of blocks, in place of as many as the memory asks for.
    pub(crate) blocks: Option<usize>,
    /// How often every block trains: from the second time on, its neighbours are those of the round before.
    pub(crate) rounds: u8,
}

/// The numbers of a task that trains.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PlanRow {
    pub(crate) id: String,
    /// The number of the round, from 1; 0: the coarse model.
    pub(crate) round: u8,
    pub(crate) views: usize,
    pub(crate) points: usize,
    pub(crate) steps: u64,
    /// The most Gaussians.
    pub(crate) gaussians: usize,
    /// Bytes that it is foreseen to take.
    pub(crate) memory: u64,
    /// Bytes of its run on disk.
    pub(crate) disk: u64,
    pub(crate) seed: u64,
}

/// `plan.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PlanFile {
    pub(super) version: u32,
    /// Of everything that the plan decides.
    pub(crate) checksum: String,
    /// [`Dataset::stamp`] of the whole dataset.
    pub(super) stamp: String,
    /// Checksum of the settings of the tasks.
    pub(super) settings: String,
    /// Memory of a worker, bytes.
    pub(crate) memory: u64,
    pub(crate) coarse: PlanRow,
    /// Round by round.
    #[serde(rename = "block")]
    pub(crate) blocks: Vec<PlanRow>,
}

impl BlockPlan {
    /// The steps of all tasks.
    pub(crate) fn steps(&self) -> u64 {
        self.file.coarse.steps + self.file.blocks.iter().map(|row| row.steps).sum::<u64>()
    }
}

impl PlanFile {
    /// The number of rounds.
    pub(crate) fn rounds(&self) -> u8 {
        self.blocks.iter().map(|row| row.round).max().unwrap_or_default()
    }

    /// The blocks of a round, from 1.
    pub(crate) fn round(&self, round: u8) -> impl Iterator<Item = &PlanRow> {
        self.blocks.iter().filter(move |row| row.round == round)
    }
}

/// A plan, before it is written.
#[derive(Debug)]
pub(crate) struct BlockPlan {
    pub(crate) file: PlanFile,
    /// The mean share of the views that a block has.
    pub(crate) shared: f64,
    /// The settings that the tasks share.
    pub(super) config: TrainConfig,
    pub(super) law: SceneTone,
    /// That of the coarse model, and those of the rows.
    pub(super) blocks: Vec<Block>,
}

impl PlanFile {
    /// The plan in a folder.
    pub(crate) fn load(folder: &Path) -> Result<Self> {
        let path = folder.join(PLAN);
        if !path.is_file() {
            let problem = "contains no plan (plan.toml); write one with `nightsplat blocks plan PHOTOS --out PLAN`";
            return Err(Error::input(folder, problem));
        }
        toml::from_str(&input::text(&path)?).map_err(|error| {
            Error::input(&path, format!("is not a plan of blocks: {}; plan anew", error.message()))
        })
    }

    /// Refuses a plan whose photographs have changed since.
    pub(crate) fn check_photographs(&self, config: &TrainConfig) -> Result<()> {
        if Dataset::stamp(&config.dataset, &config.load_options())? == self.stamp {
            return Ok(());
        }
        let problem = "has changed since the plan was made; plan anew in another folder";
        Err(Error::input(&config.dataset, problem))
    }
}
