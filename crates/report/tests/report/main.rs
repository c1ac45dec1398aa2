//! Pages, tables and charts.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../../../../tests/common/files.rs"]
mod common;

mod pages;
