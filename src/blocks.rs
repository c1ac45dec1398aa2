//! Scenes that outgrow a device: cut into blocks, which train as ordinary runs, and joined.
//!
//! ```text
//! photographs -> plan: law, frame, cells, tasks -> coarse run -> a run for each block -> join: tiles -> eval, export
//! ```
//!
//! - `partition`: the cells of a scene, from its points
//! - `visibility`: which views show a cell
//! - `budget`: the memory of a block's training
//! - `task`: what schedulers read
//! - `plan`: everything that is measured and decided once
//! - `draft`: the numbers of the tasks, and the views and points of the blocks
//! - `planning`: makes a plan
//! - `speed`: the time of a step, for the hours of a plan
//! - `folder`: the files of a plan, its tasks and the settings of each
//! - `join`: the tiles of the joined model

mod budget;
mod draft;
mod folder;
mod join;
mod plan;
mod planning;
mod speed;
mod task;

pub(crate) use join::join;
pub(crate) use plan::{BlockPlan, MAX_ROUNDS, PlanRow, Request};
pub(crate) use planning::plan;
pub(crate) use speed::speed;
pub(crate) use task::{Task, load as load_tasks};
