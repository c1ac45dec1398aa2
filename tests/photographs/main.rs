//! From files to targets: images, datasets, tone curves, fits and pseudo-GT.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[macro_use]
#[path = "../common/mod.rs"]
mod common;

mod curve_files;
mod curves;
mod exposure;
mod expressions;
mod fit;
mod formats;
mod hostile_bytes;
mod lamp;
mod metrics;
mod night;
mod properties;
mod pseudo_gt;
mod street;
mod synthetic;
mod tone;
