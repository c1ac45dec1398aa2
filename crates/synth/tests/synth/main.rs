//! Synthetic sets: their layout, light, nights and lamps.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../../../../tests/common/files.rs"]
mod common;

mod lamp;
mod night;
mod street;
mod synthetic;
