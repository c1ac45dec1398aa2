//! The numbers of the tasks of a plan, and the views and points of its blocks.

use nightsplat_core::hash;
use nightsplat_core::random::Stream;
use nightsplat_photographs::dataset::Dataset;
use nightsplat_photographs::dataset::block::{Block, Cell};

use super::budget::Budget;
use super::plan::{COARSE, PlanFile, PlanRow, Request};
use crate::train::TrainConfig;
use nightsplat_photographs::dataset::block::partition::BlockCells;
use nightsplat_photographs::dataset::block::visibility::Visibility;

/// The share of the steps that the coarse model takes.
const COARSE_STEPS: f64 = 0.125;
/// The share of the steps that each round after the first takes.
const ROUND_STEPS: f64 = 0.25;

/// What the numbers of the tasks follow from.
pub(super) struct Draft<'a> {
    pub(super) dataset: &'a Dataset,
    pub(super) visibility: &'a Visibility<'a>,
    pub(super) config: &'a TrainConfig,
    pub(super) budget: Budget,
    pub(super) request: &'a Request,
    /// The views of the coarse model, as places in [`Visibility::training`].
    pub(super) thinned: Vec<usize>,
}

impl Draft<'_> {
    /// The row of the coarse model.
    pub(super) fn coarse(&self) -> PlanRow {
        let steps = COARSE_STEPS * self.config.steps as f64;
        let [views, points] = [self.thinned.len(), self.dataset.points.len()];
        self.row(COARSE.to_owned(), 0, [views, points], steps, self.config.max_gaussians as f64)
    }

    /// The rows of the blocks, round by round. The blocks of a round share its steps by their views.
    pub(super) fn rows(&self, parts: &[BlockCells], serving: &[Vec<usize>]) -> Vec<PlanRow> {
        let all: usize = serving.iter().map(Vec::len).sum();
        let later = ROUND_STEPS * f64::from(self.request.rounds - 1);
        let mut rows = vec![];
        for round in 1..=self.request.rounds {
            let share = if round == 1 { 1.0 - COARSE_STEPS - later } else { ROUND_STEPS };
            let steps = share * self.config.steps as f64;
            for (number, (part, views)) in parts.iter().zip(serving).enumerate() {
                let points = self.dataset.points.iter();
                let points = points.filter(|point| part.halo.contains(point.position)).count();
                let block_steps = steps * views.len() as f64 / all.max(1) as f64;
                let gaussians = part.share * self.config.max_gaussians as f64;
                let id = round_id(number, round);
                rows.push(self.row(id, round, [views.len(), points], block_steps, gaussians));
            }
        }
        rows
    }

    fn row(
        &self,
        id: String,
        round: u8,
        [views, points]: [usize; 2],
        steps: f64,
        gaussians: f64,
    ) -> PlanRow {
        let most = self.request.memory as f64;
        let budget = if round == 0 { self.budget.at_half_size() } else { self.budget };
        let fits = budget.gaussians(most);
        let gaussians = if self.request.blocks.is_some() { gaussians } else { gaussians.min(fits) };
        let key = hash::checksum(id.as_bytes());
        PlanRow {
            round,
            views,
            points,
            steps: (steps.round() as u64).max(1),
            gaussians: (gaussians as usize).max(1),
            memory: budget.memory(gaussians, views as f64, most) as u64,
            disk: budget.disk(gaussians) as u64,
            // Settings are whole numbers of 63 bits.
            seed: Stream::new(self.config.seed, key).bits(0) >> 1,
            id,
        }
    }

    /// The block of the coarse model and those of the rows.
    pub(super) fn blocks(
        &self,
        file: &PlanFile,
        parts: &[BlockCells],
        serving: &[Vec<usize>],
    ) -> Vec<Block> {
        let plan = file.checksum.as_str();
        let mut blocks = vec![self.block(COARSE, plan, [Cell::WORLD; 2], &self.thinned)];
        for (row, number) in file.blocks.iter().zip((0..parts.len()).cycle()) {
            let BlockCells { core, halo, .. } = parts[number];
            // In later rounds the surroundings are the neighbours' own.
            let halo = if row.round == 1 { halo } else { core };
            let mut block = self.block(&row.id, plan, [core, halo], &serving[number]);
            let others = parts.iter().enumerate();
            let others =
                others.filter(|(other, part)| *other != number && part.halo.overlaps(&halo));
            block.neighbours = others.map(|(other, _)| block_id(other)).collect();
            blocks.push(block);
        }
        blocks
    }

    /// The block on these views; its dataset's path is set where it is written.
    fn block(&self, id: &str, plan: &str, cells: [Cell; 2], views: &[usize]) -> Block {
        let mut block = Block::new(id, plan, self.dataset.root.clone(), cells);
        let name = |&view: &usize| self.dataset.views[self.visibility.training[view]].name.clone();
        block.views = views.iter().map(name).collect();
        let points = (0..).zip(&self.dataset.points);
        let inside = points.filter(|(_, point)| block.halo.contains(point.position));
        block.points = inside.map(|(number, _)| number).collect();
        block
    }
}

/// The name of a block.
pub(super) fn block_id(number: usize) -> String {
    format!("{number:04}")
}

/// The name of a block's task in a round.
fn round_id(number: usize, round: u8) -> String {
    if round == 1 { block_id(number) } else { format!("{}-{round}", block_id(number)) }
}
