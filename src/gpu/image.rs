//! Images of a host: kernels work on buffers, and copies take pixels from an image and give them back.
//!
//! So every pass keeps its reference, and images that no kernel could write, such as those of a swapchain or of depth,
//! are as good as any other.

use ash::vk;
use ash::vk::Handle as _;

use super::{Buffer, Recorder};

/// The state of an image before or after a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageState {
    /// `VkImageLayout`.
    pub layout: i32,
    /// The queue family that owns it; `VK_QUEUE_FAMILY_IGNORED` where ownership is not transferred.
    pub family: u32,
    /// `VkPipelineStageFlags2` of the host's commands that use it.
    pub stages: u64,
    /// `VkAccessFlags2` of these commands.
    pub access: u64,
}

impl ImageState {
    const fn new(
        layout: vk::ImageLayout,
        stages: vk::PipelineStageFlags2,
        access: vk::AccessFlags2,
    ) -> Self {
        let (layout, family) = (layout.as_raw(), vk::QUEUE_FAMILY_IGNORED);
        Self { layout, family, stages: stages.as_raw(), access: access.as_raw() }
    }

    /// Contents that are not needed.
    pub const UNDEFINED: Self = Self::new(
        vk::ImageLayout::UNDEFINED,
        vk::PipelineStageFlags2::NONE,
        vk::AccessFlags2::NONE,
    );
    /// Sampled by fragment shaders.
    pub const SAMPLED: Self = Self::new(
        vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL,
        vk::PipelineStageFlags2::FRAGMENT_SHADER,
        vk::AccessFlags2::SHADER_READ,
    );
    /// A colour attachment.
    pub const COLOR_ATTACHMENT: Self = Self::new(
        vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL,
        vk::PipelineStageFlags2::COLOR_ATTACHMENT_OUTPUT,
        vk::AccessFlags2::from_raw(
            vk::AccessFlags2::COLOR_ATTACHMENT_READ.as_raw()
                | vk::AccessFlags2::COLOR_ATTACHMENT_WRITE.as_raw(),
        ),
    );
    /// A depth attachment.
    pub const DEPTH_ATTACHMENT: Self = Self::new(
        vk::ImageLayout::DEPTH_STENCIL_ATTACHMENT_OPTIMAL,
        vk::PipelineStageFlags2::from_raw(
            vk::PipelineStageFlags2::EARLY_FRAGMENT_TESTS.as_raw()
                | vk::PipelineStageFlags2::LATE_FRAGMENT_TESTS.as_raw(),
        ),
        vk::AccessFlags2::from_raw(
            vk::AccessFlags2::DEPTH_STENCIL_ATTACHMENT_READ.as_raw()
                | vk::AccessFlags2::DEPTH_STENCIL_ATTACHMENT_WRITE.as_raw(),
        ),
    );
    /// The source of the host's own copies.
    pub const TRANSFER_SOURCE: Self = Self::new(
        vk::ImageLayout::TRANSFER_SRC_OPTIMAL,
        vk::PipelineStageFlags2::ALL_TRANSFER,
        vk::AccessFlags2::TRANSFER_READ,
    );
    /// The target of the host's own copies.
    pub const TRANSFER_TARGET: Self = Self::new(
        vk::ImageLayout::TRANSFER_DST_OPTIMAL,
        vk::PipelineStageFlags2::ALL_TRANSFER,
        vk::AccessFlags2::TRANSFER_WRITE,
    );
    /// Presented by a swapchain; the semaphore that the host signals orders it.
    pub const PRESENT: Self = Self::new(
        vk::ImageLayout::PRESENT_SRC_KHR,
        vk::PipelineStageFlags2::NONE,
        vk::AccessFlags2::NONE,
    );
}

/// A format of images that we read or write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names are Vulkan's")]
pub enum ImageFormat {
    Rgba16Float,
    Rgba32Float,
    B10G11R11Float,
    Rgba8Unorm,
    Rgba8Srgb,
    Bgra8Unorm,
    Bgra8Srgb,
    A2B10G10R10Unorm,
    A2R10G10B10Unorm,
    Rg16Float,
    Rg32Float,
    R32Float,
    D32Float,
    D32FloatS8,
    D24UnormX8,
    D24UnormS8,
    D16Unorm,
}

/// With Vulkan's constant and the bytes of a copied pixel.
const FORMATS: [(ImageFormat, vk::Format, usize); 17] = [
    (ImageFormat::Rgba16Float, vk::Format::R16G16B16A16_SFLOAT, 8),
    (ImageFormat::Rgba32Float, vk::Format::R32G32B32A32_SFLOAT, 16),
    (ImageFormat::B10G11R11Float, vk::Format::B10G11R11_UFLOAT_PACK32, 4),
    (ImageFormat::Rgba8Unorm, vk::Format::R8G8B8A8_UNORM, 4),
    (ImageFormat::Rgba8Srgb, vk::Format::R8G8B8A8_SRGB, 4),
    (ImageFormat::Bgra8Unorm, vk::Format::B8G8R8A8_UNORM, 4),
    (ImageFormat::Bgra8Srgb, vk::Format::B8G8R8A8_SRGB, 4),
    (ImageFormat::A2B10G10R10Unorm, vk::Format::A2B10G10R10_UNORM_PACK32, 4),
    (ImageFormat::A2R10G10B10Unorm, vk::Format::A2R10G10B10_UNORM_PACK32, 4),
    (ImageFormat::Rg16Float, vk::Format::R16G16_SFLOAT, 4),
    (ImageFormat::Rg32Float, vk::Format::R32G32_SFLOAT, 8),
    (ImageFormat::R32Float, vk::Format::R32_SFLOAT, 4),
    (ImageFormat::D32Float, vk::Format::D32_SFLOAT, 4),
    (ImageFormat::D32FloatS8, vk::Format::D32_SFLOAT_S8_UINT, 4),
    (ImageFormat::D24UnormX8, vk::Format::X8_D24_UNORM_PACK32, 4),
    (ImageFormat::D24UnormS8, vk::Format::D24_UNORM_S8_UINT, 4),
    (ImageFormat::D16Unorm, vk::Format::D16_UNORM, 2),
];

impl ImageFormat {
    /// The format with this `VkFormat`; `None` for one that we neither read nor write.
    pub fn from_vulkan(format: i32) -> Option<Self> {
        FORMATS.iter().find(|(_, vulkan, _)| vulkan.as_raw() == format).map(|(format, ..)| *format)
    }

    /// Bytes of a pixel in a copy.
    pub(crate) fn bytes(self) -> usize {
        FORMATS.iter().find(|(format, ..)| *format == self).map_or(4, |(.., bytes)| *bytes)
    }

    /// The aspects of the image, and the one that is copied.
    fn aspects(self) -> [vk::ImageAspectFlags; 2] {
        let (color, depth) = (vk::ImageAspectFlags::COLOR, vk::ImageAspectFlags::DEPTH);
        match self {
            Self::D32FloatS8 | Self::D24UnormS8 => [depth | vk::ImageAspectFlags::STENCIL, depth],
            Self::D32Float | Self::D24UnormX8 | Self::D16Unorm => [depth; 2],
            _ => [color; 2],
        }
    }
}

/// A two-dimensional image of the host's: its mip level 0, one sample. It has usage `TRANSFER_DST` to be written and
/// `TRANSFER_SRC` to be read.
#[derive(Clone, Copy, Debug)]
pub struct HostImage {
    /// `VkImage`.
    pub handle: u64,
    /// Its format.
    pub format: ImageFormat,
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// The array layer.
    pub layer: u32,
    /// The state that the host leaves it in.
    pub before: ImageState,
    /// The state that it is in afterwards.
    pub after: ImageState,
}

impl Recorder<'_> {
    /// Copies the pixels of `image` into `buffer`, (H, W) in rows without padding; only its `size` is read.
    pub(crate) fn take_image(
        &mut self,
        image: &HostImage,
        size: [u32; 2],
        buffer: &mut Buffer<u32>,
    ) {
        self.copy_image(image, size, buffer.bound().raw, true);
    }

    /// Copies `buffer`, (H, W) in rows without padding, into the pixels of `image` within `size`.
    pub(crate) fn give_image<T: bytemuck::Pod>(
        &mut self,
        buffer: &Buffer<T>,
        image: &HostImage,
        size: [u32; 2],
    ) {
        self.copy_image(image, size, buffer.bound().raw, false);
    }

    /// Copies from an image to a buffer or the reverse.
    fn copy_image(
        &mut self,
        image: &HostImage,
        size: [u32; 2],
        buffer: vk::Buffer,
        is_taken: bool,
    ) {
        let during =
            if is_taken { ImageState::TRANSFER_SOURCE } else { ImageState::TRANSFER_TARGET };
        self.synchronize([(buffer, is_taken)].into_iter());
        self.image_barrier(image, image.before, during);
        let (regions, layout) = ([region(image, size)], vk::ImageLayout::from_raw(during.layout));
        let raw = vk::Image::from_raw(image.handle);
        let device = &self.shared().device;
        // SAFETY: recording; the host keeps its image alive, and the buffer holds the region.
        unsafe {
            if is_taken {
                device.cmd_copy_image_to_buffer(self.commands, raw, layout, buffer, &regions);
            } else {
                device.cmd_copy_buffer_to_image(self.commands, buffer, raw, layout, &regions);
            }
        }
        self.image_barrier(image, during, image.after);
    }

    /// Takes the image from one state to another; where the families differ, our half of the transfer.
    fn image_barrier(&mut self, image: &HostImage, from: ImageState, to: ImageState) {
        let family = self.family();
        let is_foreign = |other: u32| other != vk::QUEUE_FAMILY_IGNORED && other != family;
        let families = match (is_foreign(from.family), is_foreign(to.family)) {
            (true, _) => [from.family, family],
            (false, true) => [family, to.family],
            (false, false) => [vk::QUEUE_FAMILY_IGNORED; 2],
        };
        let [aspects, _] = image.format.aspects();
        let range = vk::ImageSubresourceRange::default()
            .aspect_mask(aspects)
            .level_count(1)
            .base_array_layer(image.layer)
            .layer_count(1);
        let barrier = [vk::ImageMemoryBarrier2::default()
            .image(vk::Image::from_raw(image.handle))
            .subresource_range(range)
            .old_layout(vk::ImageLayout::from_raw(from.layout))
            .new_layout(vk::ImageLayout::from_raw(to.layout))
            .src_queue_family_index(families[0])
            .dst_queue_family_index(families[1])
            .src_stage_mask(vk::PipelineStageFlags2::from_raw(from.stages))
            .src_access_mask(vk::AccessFlags2::from_raw(from.access))
            .dst_stage_mask(vk::PipelineStageFlags2::from_raw(to.stages))
            .dst_access_mask(vk::AccessFlags2::from_raw(to.access))];
        let info = vk::DependencyInfo::default().image_memory_barriers(&barrier);
        // SAFETY: recording; the host keeps its image alive and tells its state.
        unsafe { self.shared().device.cmd_pipeline_barrier2(self.commands, &info) };
    }
}

fn region(image: &HostImage, [width, height]: [u32; 2]) -> vk::BufferImageCopy {
    let [_, aspect] = image.format.aspects();
    let layers = vk::ImageSubresourceLayers::default()
        .aspect_mask(aspect)
        .base_array_layer(image.layer)
        .layer_count(1);
    vk::BufferImageCopy::default().image_subresource(layers).image_extent(vk::Extent3D {
        width,
        height,
        depth: 1,
    })
}
