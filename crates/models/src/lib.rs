//! 3D Gaussians on the host and the files of models, without Vulkan. Part of `nightsplat`, which exports the API.
//!
//! - [`attributes`]: the table of the attributes of a Gaussian
//! - [`harmonics`]: the SH basis, and its rotation
//! - [`gaussians`]: Gaussians, and their PLY
//! - [`file_kind`]: the formats of model files by their content
//! - [`levels`]: levels of detail: neighbours merged
//! - [`export`]: a model in other formats, and as a page with a viewer
//! - [`files`]: model files of any format, read
//! - [`joined`]: a model in tiles, of a scene that was trained in blocks
//! - [`edit`]: changes of a model
//! - [`linear_light`]: renders and colours in the light of the photographs

pub mod attributes;
#[cfg(feature = "train")]
pub mod edit;
#[cfg(feature = "train")]
pub mod export;
pub mod file_kind;
#[cfg(feature = "train")]
pub mod files;
pub mod gaussians;
pub mod harmonics;
#[cfg(feature = "train")]
pub mod joined;
#[cfg(feature = "train")]
pub mod levels;
#[cfg(feature = "train")]
pub mod linear_light;
