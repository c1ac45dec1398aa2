//! Gaussians: how they lie in memory, how they are drawn, and how they learn.
//!
//! In: points or a model file, cameras, the gradient of the loss with respect to a render. Out: renders, and better
//! Gaussians.
//!
//! - [`attributes`]: the one table of what every Gaussian has
//! - [`halves`]: how numbers are stored, and those of 16 bits
//! - [`harmonics`]: the basis of view-dependent colour on the host, and its rotation
//! - [`batches`]: Gaussians of more planes than one binding holds
//! - [`scene`]: Gaussians on the host and on the device, PLY
//! - [`sort`]: scan and radix sort on the device
//! - [`optimizer`]: Adam, what it learns beside the Gaussians, and the schedules of its rates
//! - [`render`]: the differentiable rasteriser
//! - [`densify`]: clone, split, prune

pub mod attributes;
pub mod batches;
#[cfg(feature = "io")]
pub mod densify;
#[cfg(any(feature = "io", feature = "check"))]
pub mod harmonics;
#[cfg(feature = "io")]
pub mod optimizer;
pub mod packed_sh;
pub mod render;
pub mod scene;
pub mod sort;
