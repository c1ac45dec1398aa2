//! The images of a host.

use ash::vk;
use ash::vk::Handle as _;
pub use ash::vk::{
    AccessFlags2 as VkAccessFlags2, Extent2D as VkExtent2D, Format as VkFormat, Image as VkImage,
    ImageLayout as VkImageLayout, PipelineStageFlags2 as VkPipelineStageFlags2,
};
use nightsplat::gpu::{HostImage, ImageFormat, ImageState};

use super::error::Failure;
use super::structs::Sized0;

/// The state of an image before or after a recording.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspImageState {
    /// The image layout.
    pub layout: VkImageLayout,
    /// The queue family that owns the image; read if `is_owned`.
    pub family: u32,
    /// The pipeline stages in which the host uses the image.
    pub stages: VkPipelineStageFlags2,
    /// The host's accesses in these stages.
    pub access: VkAccessFlags2,
    /// 1: `family` owns the image, and if it is not the lent family, the library's half of the ownership transfer is
    /// recorded; 0: ownership is not transferred.
    pub is_owned: u32,
    /// Unused.
    pub reserved: u32,
}

/// An array layer of an image: mip level 0, single-sampled. Its usage includes `TRANSFER_DST` if it is written, and
/// `TRANSFER_SRC` if it is read.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspImage {
    /// `sizeof(NspImage)`.
    pub struct_size: usize,
    /// The image.
    pub image: VkImage,
    /// Its format.
    pub format: VkFormat,
    /// Width and height in pixels, at least those of the cameras.
    pub extent: VkExtent2D,
    /// The array layer of the first camera.
    pub layer: u32,
    /// The number of array layers; 0 stands for 1.
    pub layers: u32,
    /// The state in which the host leaves the image.
    pub before: NspImageState,
    /// The state after the render.
    pub after: NspImageState,
}

// SAFETY: the size comes first; null handles are zeros.
unsafe impl Sized0 for NspImage {
    const NAME: &'static str = "NspImage";
    const FIRST_SIZE: usize = size_of::<Self>();
}

/// An image that a render of this many cameras reads or writes.
pub(super) fn lent(image: &NspImage, name: &str, cameras: u32) -> Result<HostImage, Failure> {
    let layers = image.layers.max(1);
    if u64::from(image.layer) + u64::from(cameras) > u64::from(layers) {
        let layer = image.layer;
        return Err(Failure::usage(format!(
            "{name} has {layers} layers (NspImage::layers), and {cameras} cameras from layer {layer} on need more"
        )));
    }
    if [image.before, image.after].iter().any(|state| state.is_owned > 1 || state.reserved != 0) {
        return Err(Failure::usage(format!("{name} has a state whose is_owned is not 0 or 1")));
    }
    let format = ImageFormat::from_vulkan(image.format.as_raw()).ok_or_else(|| {
        Failure::usage(format!(
            "{name} has format {:?}; take RGBA16F, RGBA32F, B10G11R11, RGBA8 or BGRA8 (UNORM, SRGB), A2B10G10R10 or \
             A2R10G10B10 for color, R32F or D32 for depth_out, RG16F or RG32F for motion_out, D32, D24, D16 or R32F \
             for scene_depth",
            image.format
        ))
    })?;
    let state = |state: NspImageState| ImageState {
        layout: state.layout.as_raw(),
        family: if state.is_owned == 0 { vk::QUEUE_FAMILY_IGNORED } else { state.family },
        stages: state.stages.as_raw(),
        access: state.access.as_raw(),
    };
    Ok(HostImage {
        handle: image.image.as_raw(),
        format,
        size: [image.extent.width, image.extent.height],
        layer: image.layer,
        before: state(image.before),
        after: state(image.after),
    })
}
