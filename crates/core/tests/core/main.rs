//! Cameras, lenses and frames.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../../../../tests/common/arbitrary.rs"]
mod arbitrary;

mod properties;
