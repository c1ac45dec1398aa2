//! Gaussians on the host, levels of detail, and formats of several files.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../../../../tests/common/arbitrary.rs"]
mod arbitrary;
#[path = "../../../../tests/common/clouds.rs"]
mod clouds;
#[path = "../../../../tests/common/files.rs"]
mod common;

mod facts;
mod levels;
mod ply;
mod properties;
mod scene;
mod streamed;
