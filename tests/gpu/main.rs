//! Device, buffers and passes: what they promise, on devices of their own and borrowed ones, and where they fail.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../common/mod.rs"]
#[macro_use]
mod common;

mod capi;
mod descriptors;
mod embedding;
mod faults;
mod gpu;
mod host;
mod images;
mod stereo;
