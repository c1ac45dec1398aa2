//! Fits of tone curves and camera profiles to pairs of photographs.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../../../../tests/common/files.rs"]
mod common;

mod curves;
mod formulas;
mod pairs;
mod profile;
