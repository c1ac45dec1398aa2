//! Device, buffers and passes: guarantees, own and borrowed devices, and failures.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../common/mod.rs"]
#[macro_use]
mod common;

mod ceiling;
mod descriptors;
mod embedding;
mod faults;
mod gpu;
#[allow(dead_code, reason = "tests of the C interface use more")]
mod host;
mod images;
mod self_test;
mod spirv;
mod stereo;
