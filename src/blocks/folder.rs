//! The folder of a plan: its files, the tasks, and the settings of each.

use std::path::{Path, PathBuf};

use nightsplat_core::camera::TrainingFrame;
use nightsplat_core::output;
use nightsplat_models::joined::{MANIFEST, MODEL};
use serde::Serialize;

use super::plan::{BLOCKS, BlockPlan, COARSE, LAW, PLAN, PlanFile, PlanRow};
use super::task::{self, TASKS, Task};
use crate::splats::optimizer::Schedule;
use crate::train::{CacheSize, TrainConfig};
use crate::{Error, Result};

/// The file of the scene's frame.
const FRAME: &str = "frame.toml";
/// The settings of a task; those that all share, with which the joined model is shown.
const CONFIG: &str = "config.toml";

impl BlockPlan {
    /// Writes the plan into a folder, `tasks.jsonl` last. The same plan may be written again.
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
        let root = absolute(&self.config.dataset)?;
        self.config.dataset = relative(&root, folder)?;
        self.law.save(&folder.join(LAW))?;
        write(&folder.join(CONFIG), self.config.to_toml())?;
        write(&folder.join(FRAME), frame_file(&self.config))?;
        let rows = std::iter::once(&self.file.coarse).chain(&self.file.blocks);
        for (row, block) in rows.zip(&self.blocks) {
            let task = folder.join(task_folder(&row.id));
            output::create_folder(&task)?;
            let mut block = block.clone();
            block.dataset = relative(&root, &task)?;
            block.save(&task)?;
            write(&task.join(CONFIG), self.settings(row).to_toml())?;
        }
        let text = toml::to_string(&self.file).map_err(|error| Error::Usage(error.to_string()));
        write(&path, text)?;
        let tasks = self.tasks();
        write(&folder.join(TASKS), task::lines(&tasks))?;
        Ok(tasks)
    }

    /// The coarse model, and in each round the blocks and the join of what they give.
    fn tasks(&self) -> Vec<Task> {
        let file = &self.file;
        let mut tasks = vec![self.training(&file.coarse, COARSE)];
        let last = file.rounds();
        for round in 1..=last {
            let before = if round == 1 { COARSE.to_owned() } else { join_id(round - 1) };
            tasks.extend(file.round(round).map(|row| self.training(row, &before)));
            let is_last = round == last;
            let mut argv = ["nightsplat", "blocks", "join", "."].map(str::to_owned).to_vec();
            if !is_last {
                argv.extend(["--round".to_owned(), round.to_string()]);
            }
            let largest = file.round(round).map(|row| row.disk).max().unwrap_or_default();
            tasks.push(Task {
                id: if is_last { "join".to_owned() } else { join_id(round) },
                needs: file.round(round).map(|row| row.id.clone()).collect(),
                argv,
                memory: 2 * largest,
                disk: file.round(round).map(|row| row.disk).sum(),
                gpu: 0,
                done: format!("{}/{MANIFEST}", model_of(round, last)),
            });
        }
        tasks
    }

    fn training(&self, row: &PlanRow, before: &str) -> Task {
        let folder = task_folder(&row.id);
        let [config, run] = [CONFIG, "run"].map(|name| format!("{folder}/{name}"));
        let argv = ["nightsplat", "train", &folder, "--config", &config, "--out", &run, "--resume"];
        let argv = argv.map(str::to_owned).to_vec();
        Task {
            id: row.id.clone(),
            needs: if row.round == 0 { vec![] } else { vec![before.to_owned()] },
            argv,
            memory: self.file.memory,
            disk: row.disk,
            gpu: 1,
            done: format!("{run}/done.json"),
        }
    }

    /// The settings of a task, with paths from the plan's folder.
    fn settings(&self, row: &PlanRow) -> TrainConfig {
        let memory = Some(CacheSize(self.file.memory));
        let shared = TrainConfig {
            dataset: task_folder(&row.id).into(),
            steps: row.steps,
            seed: row.seed,
            max_gaussians: row.gaussians,
            max_vram: memory,
            max_ram: memory,
            ..self.config.clone()
        };
        match row.round {
            // Blocks go on from the coarse model, which is trained at half size and has no cooldown.
            0 => TrainConfig {
                schedule: Schedule { cooldown_steps: 0, ..shared.schedule.clone() },
                downscale: 2.0 * shared.downscale,
                max_resolution: shared.max_resolution.div_ceil(2),
                ..shared
            },
            round => {
                let init = match round {
                    1 => format!("{COARSE}/run/model.ply"),
                    _ => model_of(round - 1, self.file.rounds()),
                };
                TrainConfig { init: Some(init.into()), schedule: self.schedule(row), ..shared }
            }
        }
    }

    /// The schedule goes on where the round before ends. The views of a block are fewer, so that a step of it stands
    /// for several of the whole scene: it is as much faster. Only the last round has the cooldown.
    fn schedule(&self, row: &PlanRow) -> Schedule {
        let steps = |round: u8| self.file.round(round).map(|row| row.steps).sum::<u64>();
        let done = self.file.coarse.steps + (1..row.round).map(steps).sum::<u64>();
        let rate = row.steps as f64 / steps(row.round).max(1) as f64;
        let rest = self.config.schedule.after_step(done, rate);
        match row.round == self.file.rounds() {
            true => rest,
            false => Schedule { cooldown_steps: 0, ..rest },
        }
    }
}

/// The name of the task that joins the blocks of a round before the last.
fn join_id(round: u8) -> String {
    format!("join-{round}")
}

/// The folder of the tiles of a round, relative to the plan's.
pub(super) fn model_of(round: u8, last: u8) -> String {
    if round == last { MODEL.to_owned() } else { format!("round-{round}") }
}

/// The folder of a task that trains, relative to the plan's.
pub(super) fn task_folder(id: &str) -> String {
    if id == COARSE { id.to_owned() } else { format!("{BLOCKS}/{id}") }
}

/// What `train --frame` reads.
fn frame_file(config: &TrainConfig) -> Result<String> {
    #[derive(Serialize)]
    struct BlockFrame {
        extent: Option<f64>,
        up: Option<[f64; 3]>,
        near: f64,
        frame: Option<TrainingFrame>,
    }
    let TrainConfig { extent, up, near, frame, .. } = *config;
    toml::to_string(&BlockFrame { extent, up, near, frame })
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
