//! From files to targets: images, datasets, exposures, scores and tone curves.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../../../../tests/common/arbitrary.rs"]
mod arbitrary;
#[path = "../../../../tests/common/files.rs"]
mod common;
#[path = "../../../../tests/common/grid.rs"]
mod grid;
#[path = "../../../../tests/common/log.rs"]
mod log;
#[path = "../../../../tests/common/png.rs"]
mod png;

mod curve_files;
mod curves;
mod exposure;
mod expressions;
mod formats;
mod metrics;
mod properties;
mod tone;
