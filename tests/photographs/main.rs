//! From files to targets by the command and on the device: datasets, poses, tone curves, fits and pseudo-GT.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[macro_use]
#[path = "../common/mod.rs"]
mod common;

mod curve_settings;
mod curves;
mod fit;
mod formats;
mod hostile_bytes;
#[path = "../../crates/fit/tests/fit/pairs.rs"]
mod pairs;
mod properties;
mod pseudo_gt;
mod synth;
