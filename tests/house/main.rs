//! House rules that the compiler does not check, and installed files.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../common/mod.rs"]
mod common;

mod architecture;
mod budget;
mod circles;
mod compilers;
mod defects;
mod documents;
mod install;
mod names;
mod settings;
mod skips;
mod words;
