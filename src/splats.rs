//! Gaussians: their memory layout, their rendering and their optimisation.
//!
//! In: points or a model file, cameras, the gradient of the loss with respect to a render. Out: renders, and updated
//! Gaussians.
//!
//! - [`attributes`]: the table of the attributes of a Gaussian
//! - [`packed_sh`]: storage formats, and 16-bit SH coefficients
//! - [`harmonics`]: the SH basis on the host, and its rotation
//! - [`batches`]: buffers of Gaussians that exceed one binding
//! - [`scene`]: Gaussians on the host and on the device, PLY
//! - [`model`]: a model with what a renderer must know of it
//! - [`lamp`]: a lamp that moves with the camera
//! - [`sort`]: scan and radix sort on the device
//! - [`optimizer`]: Adam, learned parameters other than the Gaussians, and learning-rate schedules
//! - [`render`]: the differentiable rasteriser
//! - [`densify`]: density control: clone, split, prune
//! - `joined`: a model in tiles, of a scene that was trained in blocks
//! - [`levels`]: levels of detail: neighbours merged
//! - [`smoothing`]: no Gaussian smaller than training views resolve

pub mod attributes;
pub mod batches;
pub(crate) mod camera;
#[cfg(feature = "train")]
pub mod densify;
pub mod harmonics;
#[cfg(feature = "train")]
pub mod joined;
pub mod lamp;
#[cfg(feature = "train")]
pub mod levels;
pub mod model;
#[cfg(feature = "train")]
pub mod optimizer;
pub mod packed_sh;
pub mod render;
pub mod scene;
#[cfg(feature = "train")]
pub mod smoothing;
pub mod sort;
