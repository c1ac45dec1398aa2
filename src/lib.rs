//! `nightsplat` trains 3D Gaussian Splatting from dark photographs, on explicit Vulkan compute.
//!
//! Data flows one way; a module uses only modules above it in this list
//! (`tests/architecture.rs` asserts it):
//!
//! ```text
//! photographs on disk -> dataset -> pseudo-GT (tone curve) ┐
//!                                                          ├-> loss -> backward -> optimizer -> densify -> next step
//! points -> scene (Gaussians) -> project -> bin -> sort -> blend ┘
//!                                                          └-> eval, export, render
//! ```

pub mod camera;
#[cfg(feature = "cli")]
pub mod cli;
pub mod dataset;
pub mod densify;
pub mod error;
pub mod eval;
pub mod export;
#[expect(unsafe_code, reason = "the only module that speaks Vulkan")]
pub mod gpu;
pub mod image;
pub mod kernels;
pub mod loss;
pub mod metrics;
pub mod optimizer;
pub mod pseudo_gt;
pub mod random;
pub mod reference;
pub mod render;
pub mod report;
pub mod scene;
pub mod sort;
pub mod tone;
pub mod train;

pub use error::{Error, Result};
