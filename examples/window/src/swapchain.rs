//! The images of the window, and the depth image that the host draws with.

use std::error::Error;

use nightsplat::ash::vk;
use nightsplat::ash::vk::Handle as _;
use nightsplat::{HostImage, ImageFormat, ImageState};

use super::device::Device;

/// A float of 32 bits: with a reversed depth and no far plane it is precise at any distance.
pub(crate) const DEPTH_FORMAT: vk::Format = vk::Format::D32_SFLOAT;

/// One of the images of the window.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Picture {
    pub(crate) image: vk::Image,
    pub(crate) view: vk::ImageView,
    /// Signalled when the image can be presented.
    pub(crate) drawn: vk::Semaphore,
}

pub(crate) struct Swapchain {
    pub(crate) raw: vk::SwapchainKHR,
    pub(crate) format: vk::Format,
    pub(crate) size: [u32; 2],
    pub(crate) pictures: Vec<Picture>,
    /// One is enough: frames use it one after the other, as barriers order.
    pub(crate) depth: vk::Image,
    pub(crate) depth_view: vk::ImageView,
    depth_memory: vk::DeviceMemory,
}

impl Swapchain {
    /// With images of `size`, where the surface leaves that open; `former` is retired, its images are not in use.
    pub(crate) fn new(
        device: &Device,
        size: [u32; 2],
        is_srgb: bool,
        former: Option<Self>,
    ) -> Result<Self, Box<dyn Error>> {
        let Device { surfaces, surface, physical, swapchains, raw, .. } = device;
        // SAFETY: device and surface are live; what is destroyed is not in use.
        unsafe {
            let able = surfaces.get_physical_device_surface_capabilities(*physical, *surface)?;
            let [width, height] = match able.current_extent {
                vk::Extent2D { width: u32::MAX, .. } => size,
                vk::Extent2D { width, height } => [width, height],
            };
            let extent = vk::Extent2D { width, height };
            // The library copies from and to the image; it needs no storage image, which an sRGB image never is.
            let usage = vk::ImageUsageFlags::COLOR_ATTACHMENT
                | vk::ImageUsageFlags::TRANSFER_DST
                | vk::ImageUsageFlags::TRANSFER_SRC;
            if !able.supported_usage_flags.contains(usage) {
                return Err("the images of this window cannot be copied from and to".into());
            }
            let formats = surfaces.get_physical_device_surface_formats(*physical, *surface)?;
            let wanted = match is_srgb {
                true => [vk::Format::B8G8R8A8_SRGB, vk::Format::R8G8B8A8_SRGB],
                false => [vk::Format::B8G8R8A8_UNORM, vk::Format::R8G8B8A8_UNORM],
            };
            let format = formats.iter().find(|offered| wanted.contains(&offered.format));
            let format = format.ok_or("the window has no images of 8 bits")?;
            let most = if able.max_image_count == 0 { u32::MAX } else { able.max_image_count };
            let info = vk::SwapchainCreateInfoKHR::default()
                .surface(*surface)
                .min_image_count(3.clamp(able.min_image_count, most))
                .image_format(format.format)
                .image_color_space(format.color_space)
                .image_extent(extent)
                .image_array_layers(1)
                .image_usage(usage)
                .pre_transform(able.current_transform)
                .composite_alpha(vk::CompositeAlphaFlagsKHR::OPAQUE)
                .present_mode(vk::PresentModeKHR::FIFO)
                .clipped(true)
                .old_swapchain(
                    former.as_ref().map_or_else(Default::default, |former_chain| former_chain.raw),
                );
            let swapchain = swapchains.create_swapchain(&info, None)?;
            if let Some(former) = former {
                former.destroy(device);
            }
            let picture = |image| {
                Ok(Picture {
                    image,
                    view: view(device, image, format.format, vk::ImageAspectFlags::COLOR)?,
                    drawn: raw.create_semaphore(&Default::default(), None)?,
                })
            };
            let images = swapchains.get_swapchain_images(swapchain)?;
            let pictures = images.into_iter().map(picture).collect::<Result<_, vk::Result>>()?;
            let (depth, depth_memory) = depth(device, extent)?;
            let depth_view = view(device, depth, DEPTH_FORMAT, vk::ImageAspectFlags::DEPTH)?;
            let (raw, format, size) = (swapchain, format.format, [width, height]);
            Ok(Self { raw, format, size, pictures, depth, depth_view, depth_memory })
        }
    }

    /// An image of the window as it is lent: between these states.
    pub(crate) fn lend_color(
        &self,
        picture: &Picture,
        before: ImageState,
        after: ImageState,
    ) -> Option<HostImage> {
        let format = ImageFormat::from_vulkan(self.format.as_raw())?;
        Some(HostImage {
            handle: picture.image.as_raw(),
            format,
            size: self.size,
            layer: 0,
            before,
            after,
        })
    }

    /// The depth image as it is lent: taken from the host's depth test and given back to it.
    pub(crate) fn lend_depth(&self) -> HostImage {
        HostImage {
            handle: self.depth.as_raw(),
            format: ImageFormat::D32Float,
            size: self.size,
            layer: 0,
            before: ImageState::DEPTH_ATTACHMENT,
            after: ImageState::DEPTH_ATTACHMENT,
        }
    }

    /// None of its images is in use.
    pub(crate) fn destroy(self, device: &Device) {
        let Device { raw, swapchains, .. } = device;
        // SAFETY: as the caller promises.
        unsafe {
            for Picture { view, drawn, .. } in self.pictures {
                raw.destroy_image_view(view, None);
                raw.destroy_semaphore(drawn, None);
            }
            raw.destroy_image_view(self.depth_view, None);
            raw.destroy_image(self.depth, None);
            raw.free_memory(self.depth_memory, None);
            swapchains.destroy_swapchain(self.raw, None);
        }
    }
}

fn view(
    device: &Device,
    image: vk::Image,
    format: vk::Format,
    aspect: vk::ImageAspectFlags,
) -> Result<vk::ImageView, vk::Result> {
    let range =
        vk::ImageSubresourceRange::default().aspect_mask(aspect).level_count(1).layer_count(1);
    let info = vk::ImageViewCreateInfo::default()
        .image(image)
        .view_type(vk::ImageViewType::TYPE_2D)
        .format(format)
        .subresource_range(range);
    // SAFETY: device and image are live.
    unsafe { device.raw.create_image_view(&info, None) }
}

/// The library reads it by a copy.
fn depth(
    device: &Device,
    extent: vk::Extent2D,
) -> Result<(vk::Image, vk::DeviceMemory), Box<dyn Error>> {
    let usage = vk::ImageUsageFlags::DEPTH_STENCIL_ATTACHMENT | vk::ImageUsageFlags::TRANSFER_SRC;
    let info = vk::ImageCreateInfo::default()
        .image_type(vk::ImageType::TYPE_2D)
        .format(DEPTH_FORMAT)
        .extent(extent.into())
        .mip_levels(1)
        .array_layers(1)
        .samples(vk::SampleCountFlags::TYPE_1)
        .usage(usage);
    // SAFETY: the device is live; the image is bound once to memory of a type that suits it.
    unsafe {
        let image = device.raw.create_image(&info, None)?;
        let needed = device.raw.get_image_memory_requirements(image);
        let memory = device.allocate(needed, vk::MemoryPropertyFlags::DEVICE_LOCAL)?;
        device.raw.bind_image_memory(image, memory, 0)?;
        Ok((image, memory))
    }
}
