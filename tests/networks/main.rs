//! The networks: their kernels, their gradients, agreement with `PyTorch`, their files.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[macro_use]
#[path = "../common/mod.rs"]
mod common;

mod files;
mod gradients;
mod halves;
mod kernels;
mod lpips;
mod model;
mod networks;
mod torch;

mod crop;

use common::{largest, narrow, widen};
