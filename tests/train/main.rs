//! Training: step by step, resumed, masked, in patches, in fewer bits.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../common/mod.rs"]
mod common;

mod curve_training;
mod diagnose;
mod few_points;
mod findings;
mod freeze;
mod holes;
mod lamp;
mod parts;
mod patches;
mod precision;
mod resume;
mod training;
mod world;
