//! Dark photographs on the host, without Vulkan: image files, datasets, tone curves, and what is measured of both. Part
//! of `nightsplat`, whose API is what it exports of it.
//!
//! - [`tree`]: files and folders by path, on the disk or in a ZIP archive
//! - [`image`]: images and their files
//! - [`white_balance`]: white balance set by the user, also by a colour chart
//! - [`metrics`]: PSNR and SSIM of a render against its reference image
//! - [`tone`]: curves that brighten a photograph
//! - [`findings`]: what is odd about the brightness of a set, in sentences
//! - [`dataset`]: photographs with their cameras and points, from disk
//! - [`exposures`]: gain and bias of views
//! - [`external_targets`]: pictures of another program that take the place of a curve
//! - [`scene_tone`]: from the measurements of a scene's photographs to the curve of each

mod colour_chart;
pub mod dataset;
pub mod exposures;
pub mod external_targets;
pub mod findings;
pub mod image;
pub mod metrics;
pub mod scene_tone;
pub mod tone;
pub mod tree;
pub mod white_balance;
