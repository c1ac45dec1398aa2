//! The C interface: `nightsplat.h` beside it is generated from it by cbindgen (`scripts/c-header.sh`).
//!
//! A function checks its arguments, calls the Rust API, and turns an error into a code with one line of text
//! ([`error`]). It catches panics: an object in which one happened can only be destroyed.
//!
//! - `error`: codes, the last error, the log
//! - `structs`: structs that grow by appending members
//! - `device`: a host's device, lent
//! - `model`: Gaussians on it
//! - `camera`: cameras, also from an engine's matrices
//! - `instance`: models of a render of several
//! - `image`: a host's images
//! - `renderer`: what renders, and what its frames have become
//! - `render`: renders recorded into images
//! - `train`: training on it

#![expect(unsafe_code, reason = "pointers of C")]

pub mod camera;
pub mod device;
pub mod error;
pub mod image;
pub mod instance;
pub mod model;
pub mod render;
pub mod renderer;
pub mod structs;
pub mod train;
