//! The networks: the denoiser of a render, the tonemapper that darkens it again, and the trunks of LPIPS.
//!
//! Images are planes, (C, H, W), row-major. A network owns its parameters with their gradients, and the memory of one
//! view: [`Denoiser::reserve`] allocates it, `forward` writes it, and `backward` reads it. Sums over pixels are partial
//! sums in a fixed order, so that results are bit-identical.
//!
//! Norms use the statistics of the image itself, in training and in inference: there are no running averages.

mod conv;
pub mod crop;
mod denoiser;
mod file;
mod half;
pub mod lpips;
mod norm;
mod norm_half;
mod parameters;
mod relu;
mod reserved;
mod tonemapper;
mod trunk;

use glam::UVec2;
use serde::{Deserialize, Serialize};

use crate::gpu::{Buffer, Gpu};
use crate::{Error, Result};

pub use conv::Precision;
pub use denoiser::{Denoiser, DenoiserSettings};
pub(crate) use file::TensorFile;
pub use file::{load, save};
pub use parameters::{Parameters, Tensor};
pub use tonemapper::Tonemapper;
pub use trunk::Network;
pub(crate) use trunk::{Trunk, published};

/// The initialisation and the output of the networks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NetworkVariant {
    /// A residual whose last layer starts at zero and has no activation: the output is the input at first.
    #[default]
    Identity,
    /// As in LITA-GS: the denoiser's last layer has a random initialisation and a sigmoid, and outputs about one half;
    /// the tonemapper outputs the whole image.
    Paper,
}

/// Red, green, blue.
const RGB: u32 = 3;

/// The columns and rows of pixels per lane of `conv3x3`.
///
/// On a CPU, loads cost most, and the neighbouring columns of a lane share them; on a GPU, neighbouring lanes read
/// neighbouring pixels, and registers limit the block: narrow subgroups have fewer for a lane's share of the weights,
/// and would spill (compiled by Mesa 25 for Arc).
const CPU_SHAPE: [u32; 2] = [4, 4];
const GPU_SHAPE: [u32; 2] = [1, 8];
const NARROW_GPU_SHAPE: [u32; 2] = [1, 6];
const NARROW_SUBGROUP: u32 = 8;

/// The columns and rows of pixels for this device.
pub(crate) fn conv_shape(gpu: &Gpu) -> [u32; 2] {
    match gpu.properties() {
        device if device.is_cpu => CPU_SHAPE,
        device if device.subgroup_size <= NARROW_SUBGROUP => NARROW_GPU_SHAPE,
        _ => GPU_SHAPE,
    }
}

/// The threads of a workgroup that every device has.
const WORKGROUP_THREADS: u32 = 256;

/// The subgroups of a workgroup that share what they read, at most `count`: on a GPU in the cache, which those of other
/// workgroups would miss.
fn side_by_side(gpu: &Gpu, count: u32) -> u32 {
    let device = gpu.properties();
    if device.is_cpu { 1 } else { count.min(WORKGROUP_THREADS / device.subgroup_size).clamp(1, 8) }
}

/// The number of pixels of a view.
fn pixel_count(size: UVec2) -> Result<usize> {
    let UVec2 { x: width, y: height } = size;
    match width as usize * height as usize {
        0 => Err(Error::Usage(format!("a view of {width} x {height} has no pixels for a network"))),
        pixels => Ok(pixels),
    }
}

/// A kernel that exceeds a buffer corrupts other data, so lengths are checked before anything is recorded.
fn check_images<const N: usize>(pixels: usize, images: [&Buffer<f32>; N]) -> Result<()> {
    let needed = RGB as usize * pixels;
    match images.into_iter().find(|image| image.len() < needed) {
        None => Ok(()),
        Some(short) => {
            let (name, len) = (short.name(), short.len());
            let problem = format!("buffer `{name}` holds {len} values, the view has {needed}");
            Err(Error::Usage(problem))
        }
    }
}

fn check_binding(gpu: &Gpu, what: &str, size: UVec2, len: usize) -> Result<()> {
    let properties = gpu.properties();
    let (bytes, limit) = (float_bytes(len), properties.max_storage_buffer_range);
    if bytes <= limit {
        return Ok(());
    }
    let (UVec2 { x: width, y: height }, device) = (size, &properties.name);
    Err(Error::Usage(format!(
        "{what} at {width} x {height} take {bytes} bytes, {device} binds {limit} at most; use a smaller crop or fewer \
         channels"
    )))
}

/// The error for a pass that does not match the preceding one.
fn out_of_turn(network: &str, size: UVec2, remedy: &str) -> Error {
    let UVec2 { x: width, y: height } = size;
    Error::Usage(format!("the {network} is not ready for a view of {width} x {height}; {remedy}"))
}

fn float_bytes(len: usize) -> u64 {
    (len as u64).saturating_mul(size_of::<f32>() as u64)
}
