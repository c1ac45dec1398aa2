//! From photographs on disk to the targets that supervise training.
//!
//! In: image files, camera files, tone curves. Out: [`dataset::Dataset`], images, and pseudo-GT targets on the device.
//!
//! - [`image`]: float images and their files
//! - [`white_balance`]: white balance set by the user, also by a colour chart
//! - [`metrics`]: PSNR and SSIM of a render against its reference image
//! - [`tone`]: curves that brighten a photograph
//! - [`fit`]: the constants of a curve from pairs of photographs
//! - [`findings`]: what is odd about the brightness of a set, in sentences
//! - [`dataset`]: photographs with their cameras and points, from disk
//! - [`pseudo_gt`]: dark photograph and curve to target, on the device
//! - [`targets`]: the curve of every view of a scene, and its target
//! - `pose`: camera poses of dark photographs, by COLMAP (feature `cli`)
//! - [`structure`]: the edges of a pseudo-GT that do not depend on its illumination

#[cfg(feature = "io")]
mod colour_chart;
#[cfg(feature = "io")]
pub mod dataset;
#[cfg(feature = "io")]
pub mod findings;
#[cfg(feature = "cli")]
pub mod fit;
pub mod image;
#[cfg(feature = "io")]
pub mod metrics;
#[cfg(feature = "cli")]
pub mod pose;
#[cfg(feature = "io")]
pub mod pseudo_gt;
#[cfg(feature = "io")]
pub mod structure;
#[cfg(feature = "io")]
pub mod targets;
pub mod tone;
#[cfg(feature = "io")]
pub mod white_balance;
