//! Runs, scores, reports and exports.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../common/mod.rs"]
mod common;

mod compare;
mod determinism;
mod edit;
mod edited;
mod export;
mod floaters;
mod injected;
mod light;
mod lost_work;
mod model_files;
mod other_programs;
mod power_cut;
mod profile;
mod rendered;
mod run;
mod scored_later;
mod turned;
