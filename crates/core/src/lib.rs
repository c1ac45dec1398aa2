//! What all of nightsplat stands on, without Vulkan: errors, files, settings, cameras, images in memory, and the
//! formulas of tone curves. Part of `nightsplat`, whose API is what it exports of it.
//!
//! - [`error`]: errors, sorted by what the user can do about them
//! - [`input`]: files that users name, read whole
//! - [`natural`]: the order of names as people count
//! - [`output`]: files that appear when complete
//! - [`lock`]: one process at a time in a folder
//! - [`csv`]: tables of comma-separated values
//! - [`table`]: tables of text
//! - [`ply`]: headers of PLY files
//! - [`hash`]: checksums of numbers and bytes
//! - [`random`]: counter-based random numbers
//! - [`settings`](mod@settings): a row for each setting: key, default, rule, unit, help, option
//! - [`camera`]: cameras and lens distortion
//! - [`image`]: images in memory
//! - [`curves`]: the formulas of tone curves
//! - [`testing`]: tests that are not run say why
//! - [`watch`]: following long work, and stopping it

pub mod camera;
pub mod csv;
pub mod curves;
pub mod error;
pub mod hash;
pub mod image;
pub mod input;
pub mod lock;
pub mod natural;
pub mod output;
pub mod ply;
pub mod random;
pub mod settings;
pub mod table;
pub mod testing;
pub mod watch;

pub use error::{Error, Result, Stop};
