//! What the photographs of a capture show, against what was done to them.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../../../../tests/common/files.rs"]
mod common;
#[path = "../../../../tests/common/sets.rs"]
mod sets;

mod captures;
mod evened_out;
mod lamp;
