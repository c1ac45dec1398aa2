//! A picture of the window, read back before it is presented.

use std::error::Error;

use nightsplat::ash::vk;

use super::device::Device;
use super::swapchain::{Picture, Swapchain};

/// Memory that a frame copies its picture to.
pub(crate) struct Shot {
    buffer: vk::Buffer,
    memory: vk::DeviceMemory,
    size: [u32; 2],
    is_blue_first: bool,
}

impl Shot {
    /// Records the copy of an image that the library left as the source of one, and hands the image on to be presented.
    pub(crate) fn record(
        device: &Device,
        commands: vk::CommandBuffer,
        swapchain: &Swapchain,
        picture: Picture,
    ) -> Result<Self, Box<dyn Error>> {
        let Swapchain { size, format, .. } = *swapchain;
        let [width, height] = size;
        let info = vk::BufferCreateInfo::default()
            .size(bytes(size) as u64)
            .usage(vk::BufferUsageFlags::TRANSFER_DST);
        let flags = vk::MemoryPropertyFlags::HOST_VISIBLE | vk::MemoryPropertyFlags::HOST_COHERENT;
        let layers = vk::ImageSubresourceLayers::default()
            .aspect_mask(vk::ImageAspectFlags::COLOR)
            .layer_count(1);
        let region = [vk::BufferImageCopy::default()
            .image_subresource(layers)
            .image_extent(vk::Extent3D { width, height, depth: 1 })];
        let copied = vk::ImageLayout::TRANSFER_SRC_OPTIMAL;
        let shown = vk::ImageLayout::PRESENT_SRC_KHR;
        let (copy, read) = (vk::PipelineStageFlags2::ALL_TRANSFER, vk::AccessFlags2::TRANSFER_READ);
        let (none, nothing) = (vk::PipelineStageFlags2::NONE, vk::AccessFlags2::NONE);
        let states = [(copied, copy, read), (shown, none, nothing)];
        let raw = &device.raw;
        // SAFETY: the command buffer is recording; image and buffer are live until the frame is done.
        let (buffer, memory) = unsafe {
            let buffer = raw.create_buffer(&info, None)?;
            let memory = device.allocate(raw.get_buffer_memory_requirements(buffer), flags)?;
            raw.bind_buffer_memory(buffer, memory, 0)?;
            raw.cmd_copy_image_to_buffer(commands, picture.image, copied, buffer, &region);
            (buffer, memory)
        };
        device.change(commands, picture.image, vk::ImageAspectFlags::COLOR, states);
        let blue_first = [vk::Format::B8G8R8A8_UNORM, vk::Format::B8G8R8A8_SRGB];
        Ok(Self { buffer, memory, size, is_blue_first: blue_first.contains(&format) })
    }

    /// The picture as a PPM file, once the frame is done.
    pub(crate) fn read(self, device: &Device) -> Result<Vec<u8>, Box<dyn Error>> {
        let Self { buffer, memory, size, is_blue_first } = self;
        let raw = &device.raw;
        // SAFETY: the memory is this long, and the frame that wrote it is done.
        let pixels = unsafe {
            let address = raw.map_memory(memory, 0, vk::WHOLE_SIZE, Default::default())?;
            let pixels = std::slice::from_raw_parts(address.cast::<u8>(), bytes(size)).to_vec();
            raw.destroy_buffer(buffer, None);
            raw.free_memory(memory, None);
            pixels
        };
        let order = if is_blue_first { [2, 1, 0] } else { [0, 1, 2] };
        let mut file = format!("P6\n{} {}\n255\n", size[0], size[1]).into_bytes();
        file.extend(pixels.chunks(4).flat_map(|pixel| order.map(|channel| pixel[channel])));
        Ok(file)
    }
}

fn bytes([width, height]: [u32; 2]) -> usize {
    4 * width as usize * height as usize
}
