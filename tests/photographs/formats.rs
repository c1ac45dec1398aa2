//! Datasets in commands, and those that `pose` makes.

mod commands;
#[cfg(feature = "raw")]
#[path = "../../crates/photographs/tests/photographs/formats/dng.rs"]
mod dng;
#[cfg(unix)]
mod make;
#[cfg(unix)]
mod pose;
#[cfg(feature = "raw")]
mod raw;
#[cfg(unix)]
#[path = "../../crates/pose/tests/pose/stub.rs"]
mod stub;
#[path = "../../crates/photographs/tests/photographs/formats/synthetic.rs"]
pub(crate) mod synthetic;
