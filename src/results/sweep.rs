//! The results of a sweep: its points with seeds averaged, a leaderboard, costs, and tables over datasets.
//!
//! In: the run directories of trainings over a grid of settings. Out: tables and pages.

mod costs;
mod leaderboard;
mod point;
mod rows;
mod run;
mod scenes;
mod table;

pub use costs::FILES as COST_FILES;
pub use leaderboard::{FILES as LEADERBOARD_FILES, Leaderboard};
pub use point::{
    ADAPTIVE, ALL_PARTS, OFFSET, PARTS, PLAIN, PRESET, RENDERS, SEED, SweepAxis, SweepPoint,
    all_curves, setting_of,
};
pub use rows::SweepResults;
pub use run::{FailedPoint, LPIPS_FILE, SweepRun, measured_later};
pub use scenes::{SceneResults, SceneTable};
