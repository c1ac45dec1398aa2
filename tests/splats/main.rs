//! Gaussians: sorting, rendering, gradients, Adam and density control.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[macro_use]
#[path = "../common/mod.rs"]
mod common;

mod antialiasing;
mod batches;
mod blending;
mod checked;
mod conditioning;
mod context;
mod coverage;
mod densify;
mod fisheye;
mod gradients;
mod learned;
mod levels;
mod limits;
mod not_finite;
mod optimizer;
mod packed_sh;
mod render;
mod sort;
mod whole_gaussians;
