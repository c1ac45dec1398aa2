//! The plan of a scene that is trained in blocks: what is measured once for all of them, and the task of each.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::budget::Budget;
use super::partition::{Part, Until, WeightedPoint, partition};
use super::task::{self, TASKS, Task};
use super::visibility::Visibility;
use crate::base::hash::{self, Hasher};
use crate::base::random::Stream;
use crate::base::{input, output};
use crate::photographs::dataset::Dataset;
use crate::photographs::dataset::block::{Block, Cell};
use crate::photographs::tone::ToneLaw;
use crate::results::joined::MANIFEST;
use crate::splats::optimizer::Schedule;
use crate::train::{CacheSize, OnOff, PlannedRun, StopConfig, TrainConfig, law_of};
use crate::{Error, Result};

/// The file of the plan's numbers.
const PLAN: &str = "plan.toml";
/// The file of the tone law.
pub(crate) const LAW: &str = "law.toml";
/// The file of the scene's frame.
const FRAME: &str = "frame.toml";
/// The settings that the tasks share, and with which the joined model is shown.
const CONFIG: &str = "config.toml";
/// The folder of the coarse model.
pub(crate) const COARSE: &str = "coarse";
/// The folder of the blocks.
pub(crate) const BLOCKS: &str = "blocks";

const VERSION: u32 = 1;
/// The share of the steps that the coarse model takes.
const COARSE_STEPS: f64 = 0.125;
/// Blocks whose mean share of the views is larger do not pay.
const MOST_SHARED: f64 = 0.75;
/// The fewest views of a block.
const LEAST_VIEWS: usize = 3;

/// What the user asks for, beside the settings of a training.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Request {
    /// Memory of a worker, bytes.
    pub(crate) memory: u64,
    /// The number of blocks, in place of as many as the memory asks for.
    pub(crate) blocks: Option<usize>,
}

/// The numbers of a task that trains.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Row {
    pub(crate) id: String,
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
    version: u32,
    /// Of everything that the plan decides.
    pub(crate) checksum: String,
    /// [`Dataset::stamp`] of the whole dataset.
    stamp: String,
    /// Checksum of the settings of the tasks.
    settings: String,
    /// Memory of a worker, bytes.
    pub(crate) memory: u64,
    pub(crate) coarse: Row,
    #[serde(rename = "block")]
    pub(crate) blocks: Vec<Row>,
}

/// A plan, before it is written.
#[derive(Debug)]
pub(crate) struct BlockPlan {
    pub(crate) file: PlanFile,
    /// The mean share of the views that a block has.
    pub(crate) shared: f64,
    config: TrainConfig,
    law: ToneLaw,
    coarse: Block,
    blocks: Vec<Block>,
}

/// Plans the blocks of a dataset. Nothing is written.
///
/// # Errors
/// The dataset has no points, or all at one place; blocks do not pay; a block has too few views; the memory is too
/// small; a photograph can no longer be read.
pub(crate) fn plan(planned: PlannedRun, request: &Request) -> Result<BlockPlan> {
    let PlannedRun { mut config, dataset, .. } = planned;
    let root = &dataset.root;
    if dataset.points.is_empty() {
        let problem =
            "has no points, by which a scene is divided; find them with `nightsplat pose`";
        return Err(Error::input(root, problem));
    }
    let visibility = Visibility::of(&dataset);
    let budget = Budget::of(&config, &dataset);
    let parts = parts(&dataset, &visibility, &config, &budget, request)?;
    let serving = visibility.serving(&parts);
    let shared = mean_share(&serving, visibility.training.len());
    check_views(root, &serving, shared)?;
    let law = law_of(&config.tone, &dataset)?;
    settle(&mut config, &dataset);
    let stamp = Dataset::stamp(root, &config.load_options())?;
    let drawn =
        Draft { dataset: &dataset, visibility: &visibility, config: &config, budget, request };
    let coarse = drawn.coarse();
    let rows = drawn.rows(&parts, &serving);
    let settings = config.checksum()?;
    let mut file = PlanFile {
        version: VERSION,
        checksum: String::new(),
        stamp,
        settings,
        memory: request.memory,
        coarse,
        blocks: rows,
    };
    file.checksum = checksum(&file, &parts)?;
    let coarse = drawn.block(COARSE, &file.checksum, [Cell::WORLD; 2], &drawn.coarse_views());
    let mut blocks: Vec<Block> = file
        .blocks
        .iter()
        .zip(&parts)
        .zip(&serving)
        .map(|((row, part), views)| {
            drawn.block(&row.id, &file.checksum, [part.core, part.halo], views)
        })
        .collect();
    let halos: Vec<(String, Cell)> =
        blocks.iter().map(|block| (block.id.clone(), block.halo)).collect();
    for block in &mut blocks {
        let others = halos.iter().filter(|(id, halo)| *id != block.id && block.halo.overlaps(halo));
        block.neighbours = others.map(|(id, _)| id.clone()).collect();
    }
    Ok(BlockPlan { file, shared, config, law, coarse, blocks })
}

/// The parts of the scene, of as much weight each as the memory allows.
fn parts(
    dataset: &Dataset,
    visibility: &Visibility<'_>,
    config: &TrainConfig,
    budget: &Budget,
    request: &Request,
) -> Result<Vec<Part>> {
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
    if config.exposure.learn == OnOff::On {
        tracing::warn!(
            "exposures of views are not learned in blocks, in which they could drift apart; the tone law keeps them"
        );
        config.exposure.learn = OnOff::Off;
    }
}

/// The name of a block.
fn block_id(number: usize) -> String {
    format!("{number:04}")
}

/// What the numbers of the tasks follow from.
struct Draft<'a> {
    dataset: &'a Dataset,
    visibility: &'a Visibility<'a>,
    config: &'a TrainConfig,
    budget: Budget,
    request: &'a Request,
}

impl Draft<'_> {
    fn row(&self, id: String, views: usize, points: usize, steps: u64, gaussians: f64) -> Row {
        let fits = self.budget.gaussians(self.request.memory as f64);
        let gaussians = if self.request.blocks.is_some() { gaussians } else { gaussians.min(fits) };
        let bytes = self.budget.memory(gaussians, views as f64, self.request.memory as f64);
        let key = hash::of(id.as_bytes());
        // Settings are whole numbers of 63 bits.
        let seed = Stream::new(self.config.seed, key).bits(0) >> 1;
        Row {
            id,
            views,
            points,
            steps: steps.max(1),
            gaussians: (gaussians as usize).max(1),
            memory: bytes as u64,
            disk: self.budget.disk(gaussians) as u64,
            seed,
        }
    }

    fn coarse(&self) -> Row {
        let steps = (COARSE_STEPS * self.config.steps as f64).round() as u64;
        let gaussians = self.config.max_gaussians as f64;
        self.row(
            COARSE.to_owned(),
            self.coarse_views().len(),
            self.dataset.points.len(),
            steps,
            gaussians,
        )
    }

    fn coarse_views(&self) -> Vec<usize> {
        self.visibility.thinned()
    }

    /// The rows of the blocks, which share the steps by their views.
    fn rows(&self, parts: &[Part], serving: &[Vec<usize>]) -> Vec<Row> {
        let all: usize = serving.iter().map(Vec::len).sum();
        let left = (1.0 - COARSE_STEPS) * self.config.steps as f64;
        let row = |(number, (part, views)): (usize, (&Part, &Vec<usize>))| {
            let points = self.dataset.points.iter();
            let points = points.filter(|point| part.halo.contains(point.position)).count();
            let steps = (left * views.len() as f64 / all.max(1) as f64).round() as u64;
            let gaussians = part.share * self.config.max_gaussians as f64;
            self.row(block_id(number), views.len(), points, steps, gaussians)
        };
        parts.iter().zip(serving).enumerate().map(row).collect()
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

/// The checksum of a plan's numbers and cells.
fn checksum(file: &PlanFile, parts: &[Part]) -> Result<String> {
    let text = toml::to_string(file).map_err(|error| Error::Usage(error.to_string()))?;
    let mut hasher = Hasher::default();
    hasher.write(text.as_bytes());
    for cell in parts.iter().flat_map(|part| [part.core, part.halo]) {
        hasher.write_numbers(&cell.from);
        hasher.write_numbers(&cell.to);
    }
    Ok(hash::text(hasher.finish()))
}

impl BlockPlan {
    /// Writes the plan into a folder, `tasks.jsonl` last. The same plan may be written again.
    ///
    /// # Errors
    /// The folder contains another plan, or cannot be written.
    pub(crate) fn save(mut self, folder: &Path) -> Result<Vec<Task>> {
        let path = folder.join(PLAN);
        if path.is_file() && PlanFile::load(folder)? != self.file {
            let problem = format!(
                "{} contains a plan with other settings or photographs; choose another folder",
                folder.display()
            );
            return Err(Error::Usage(problem));
        }
        output::create_folder(folder)?;
        let root = absolute(&self.coarse.dataset)?;
        self.config.dataset = relative(&root, folder)?;
        let tasks = self.tasks();
        self.law.save(&folder.join(LAW))?;
        write(&folder.join(CONFIG), self.config.to_toml())?;
        write(&folder.join(FRAME), frame_file(&self.config))?;
        let coarse = (self.coarse_settings(), &self.coarse);
        let others = self.file.blocks.iter().map(|row| self.block_settings(row)).zip(&self.blocks);
        for (settings, block) in std::iter::once(coarse).chain(others) {
            let place = folder.join(place(&block.id));
            output::create_folder(&place)?;
            let mut block = block.clone();
            block.dataset = relative(&root, &place)?;
            block.save(&place)?;
            write(&place.join(CONFIG), settings.to_toml())?;
        }
        let text = toml::to_string(&self.file).map_err(|error| Error::Usage(error.to_string()));
        write(&path, text)?;
        write(&folder.join(TASKS), task::lines(&tasks))?;
        Ok(tasks)
    }

    fn tasks(&self) -> Vec<Task> {
        let PlanFile { coarse, blocks, .. } = &self.file;
        let mut tasks = vec![self.training(coarse, vec![])];
        tasks.extend(blocks.iter().map(|row| self.training(row, vec![COARSE.to_owned()])));
        let largest = blocks.iter().map(|row| row.disk).max().unwrap_or_default();
        tasks.push(Task {
            id: "join".to_owned(),
            needs: blocks.iter().map(|row| row.id.clone()).collect(),
            argv: ["nightsplat", "blocks", "join", "."].map(str::to_owned).to_vec(),
            memory: 2 * largest,
            disk: blocks.iter().map(|row| row.disk).sum(),
            gpu: 0,
            done: MANIFEST.to_owned(),
        });
        tasks
    }

    fn training(&self, row: &Row, needs: Vec<String>) -> Task {
        let place = place(&row.id);
        let [config, run] = [CONFIG, "run"].map(|name| format!("{place}/{name}"));
        let argv = ["nightsplat", "train", &place, "--config", &config, "--out", &run, "--resume"];
        let argv = argv.map(str::to_owned).to_vec();
        let done = format!("{run}/done.json");
        Task {
            id: row.id.clone(),
            needs,
            argv,
            memory: self.file.memory,
            disk: row.disk,
            gpu: 1,
            done,
        }
    }

    /// The settings of a task, with paths from the plan's folder.
    fn settings(&self, row: &Row) -> TrainConfig {
        let memory = Some(CacheSize(self.file.memory));
        TrainConfig {
            dataset: place(&row.id).into(),
            steps: row.steps,
            seed: row.seed,
            max_gaussians: row.gaussians,
            max_vram: memory,
            max_ram: memory,
            ..self.config.clone()
        }
    }

    /// The coarse model is trained at half size. Blocks go on from it, so it has no cooldown.
    fn coarse_settings(&self) -> TrainConfig {
        let settings = self.settings(&self.file.coarse);
        let schedule = Schedule { cooldown_steps: 0, ..settings.schedule.clone() };
        TrainConfig {
            schedule,
            downscale: 2.0 * settings.downscale,
            max_resolution: settings.max_resolution.div_ceil(2),
            ..settings
        }
    }

    /// A block goes on where the coarse model ends. Its views are fewer, so that a step of it stands for several of the
    /// whole scene: the schedule is as much faster.
    fn block_settings(&self, row: &Row) -> TrainConfig {
        let done = self.file.coarse.steps;
        let left = self.config.steps.saturating_sub(done).max(1);
        let schedule = self.config.schedule.from_step(done, row.steps as f64 / left as f64);
        let init = Some(format!("{COARSE}/run/model.ply").into());
        TrainConfig { init, schedule, ..self.settings(row) }
    }
}

/// The folder of a task that trains, relative to the plan's.
fn place(id: &str) -> String {
    if id == COARSE { id.to_owned() } else { format!("{BLOCKS}/{id}") }
}

impl PlanFile {
    /// The plan in a folder.
    ///
    /// # Errors
    /// There is none, or it is damaged.
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
    ///
    /// # Errors
    /// [`Error::Input`] with the dataset.
    pub(crate) fn check_photographs(&self, config: &TrainConfig) -> Result<()> {
        if Dataset::stamp(&config.dataset, &config.load_options())? == self.stamp {
            return Ok(());
        }
        let problem = "has changed since the plan was made; plan anew in another folder";
        Err(Error::input(&config.dataset, problem))
    }
}

/// What `train --frame` reads.
fn frame_file(config: &TrainConfig) -> Result<String> {
    #[derive(Serialize)]
    struct Frame {
        extent: Option<f64>,
        up: Option<[f64; 3]>,
        near: f64,
        frame: Option<crate::camera::TrainingFrame>,
    }
    let TrainConfig { extent, up, near, frame, .. } = *config;
    toml::to_string(&Frame { extent, up, near, frame })
        .map_err(|error| Error::Usage(error.to_string()))
}

fn write(path: &Path, text: Result<String>) -> Result<()> {
    output::write_whole(path, text?.as_bytes())
}

fn absolute(path: &Path) -> Result<PathBuf> {
    let unreadable = |error| Error::input(path, format!("cannot be found: {error}"));
    path.canonicalize().or_else(|_| std::path::absolute(path)).map_err(unreadable)
}

/// A path from an existing folder, so that both may move together.
fn relative(path: &Path, folder: &Path) -> Result<PathBuf> {
    Ok(pathdiff::diff_paths(path, absolute(folder)?).unwrap_or_else(|| path.to_owned()))
}
