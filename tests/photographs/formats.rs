//! Datasets in commands, and those that `pose` makes.

mod commands;
#[cfg(unix)]
mod make;
#[cfg(unix)]
mod pose;
#[cfg(unix)]
mod pose_bright;
#[cfg(unix)]
mod pose_cameras;
#[cfg(feature = "raw")]
mod raw;
#[path = "../../crates/photographs/tests/photographs/formats/synthetic.rs"]
pub(crate) mod synthetic;
