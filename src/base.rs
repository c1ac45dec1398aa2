//! The base of all other modules, independent of splatting: files read and written whole, hashes, random numbers.
//!
//! - [`input`]: files that users name, read whole
//! - [`csv`]: tables of comma-separated values
//! - [`output`]: files that appear when complete
//! - [`hash`]: checksums of numbers and bytes
//! - [`ply`]: headers of PLY files
//! - [`random`]: counter-based random numbers
//! - [`settings`]: a row for each setting: key, default, rule, unit, help, option
//! - [`tree`]: files and folders by path, on the disk or in a ZIP archive

#[cfg(feature = "io")]
pub mod csv;
#[cfg(feature = "io")]
pub mod hash;
pub mod input;
pub mod output;
pub mod ply;
#[cfg(feature = "io")]
pub mod random;
#[cfg(feature = "io")]
pub mod settings;
#[cfg(feature = "io")]
pub mod tree;
