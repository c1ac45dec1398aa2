//! Windows: a device that presents, and the images of a window that it draws into.
//!
//! A frame is recorded and submitted like any other work, between those of other threads. It is waited for before it is
//! presented, so that neither semaphores nor frames in flight are needed.

use std::ffi::c_char;
use std::sync::Arc;

use ash::vk::Handle as _;
use ash::{khr, vk};
use raw_window_handle::{HandleError, HasDisplayHandle, HasWindowHandle};

use super::{Gpu, HostImage, ImageFormat, ImageState, Shared, lock};
use crate::{DeviceChoice, Error, Result};

/// The instance extensions that windows of a display need.
pub(super) fn extensions(display: &dyn HasDisplayHandle) -> Result<&'static [*const c_char]> {
    let display = display.display_handle().map_err(|error| no_window(&error))?.as_raw();
    ash_window::enumerate_required_extensions(display)
        .map_err(|result| Error::NoDevice(format!("Vulkan presents to no such display ({result})")))
}

fn no_window(error: &HandleError) -> Error {
    Error::Usage(format!("the window cannot be drawn into: {error}"))
}

impl Gpu {
    /// [`Gpu::new`] for a device that presents to windows of a display.
    pub(crate) fn with_display(
        choice: &DeviceChoice,
        display: &dyn HasDisplayHandle,
    ) -> Result<Self> {
        Self::open_to_present(choice, extensions(display)?)?.tested()
    }
}

/// A window to draw into.
pub(crate) struct Surface {
    gpu: Gpu,
    surfaces: khr::surface::Instance,
    swapchains: khr::swapchain::Device,
    raw: vk::SurfaceKHR,
    /// Signalled when an image is free.
    acquired: vk::Fence,
    chain: Option<Chain>,
    /// It has to live as long as its surface.
    _window: Arc<dyn HasWindowHandle>,
}

/// The images of a window of one size.
struct Chain {
    raw: vk::SwapchainKHR,
    images: Vec<vk::Image>,
    format: ImageFormat,
    size: [u32; 2],
}

/// An image of the window that is drawn into and then presented.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Acquired {
    /// Its contents are not needed before; it is presented after.
    pub(crate) image: HostImage,
    index: u32,
}

impl std::fmt::Debug for Surface {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Surface").field("size", &self.chain.as_ref().map(|own| own.size)).finish()
    }
}

impl Surface {
    pub(crate) fn new<W: HasDisplayHandle + HasWindowHandle + 'static>(
        gpu: &Gpu,
        window: &Arc<W>,
    ) -> Result<Self> {
        let shared = &gpu.shared;
        let Some(owned) = &shared.owned else {
            return Err(Error::Usage("a device of a host presents itself".to_owned()));
        };
        let display = window.display_handle().map_err(|error| no_window(&error))?.as_raw();
        let handle = window.window_handle().map_err(|error| no_window(&error))?.as_raw();
        let (entry, instance) = (&owned.entry, &owned.instance);
        let fail = |call| move |result| shared.error(call, result);
        // SAFETY: the handles are those of a live window, which is kept as long as the surface.
        let raw = unsafe { ash_window::create_surface(entry, instance, display, handle, None) }
            .map_err(fail("vkCreateSurface"))?;
        let fence = vk::FenceCreateInfo::default();
        // SAFETY: the device is live.
        let acquired = unsafe { shared.device.create_fence(&fence, None) };
        let surface = Self {
            gpu: gpu.clone(),
            surfaces: khr::surface::Instance::new(entry, instance),
            swapchains: khr::swapchain::Device::new(instance, &shared.device),
            raw,
            acquired: acquired.as_ref().copied().unwrap_or_default(),
            chain: None,
            _window: Arc::clone(window) as Arc<dyn HasWindowHandle>,
        };
        acquired.map_err(fail("vkCreateFence"))?;
        // SAFETY: the surface is live, and the family one of the device's.
        let presents = unsafe {
            surface.surfaces.get_physical_device_surface_support(
                shared.physical,
                shared.family,
                raw,
            )
        };
        if presents.map_err(fail("vkGetPhysicalDeviceSurfaceSupportKHR"))? {
            return Ok(surface);
        }
        let device = &shared.properties.name;
        Err(Error::NoDevice(format!(
            "{device} does not present to this window; name another --device"
        )))
    }

    /// An image to draw into, of the size of the window, which is `size` where the surface leaves that open; `None` if
    /// the window has no area, or has just changed.
    pub(crate) fn acquire(&mut self, size: [u32; 2]) -> Result<Option<Acquired>> {
        let shared = &Arc::clone(&self.gpu.shared);
        let fail = |call| move |result| shared.error(call, result);
        if self.chain.as_ref().is_none_or(|chain| chain.size != size) {
            self.chain = self.new_chain(size)?;
        }
        let Some(chain) = &self.chain else { return Ok(None) };
        let device = &shared.device;
        // SAFETY: the chain is live; the fence is unsignalled, and waited for before it is reset.
        let index = unsafe {
            let none = vk::Semaphore::null();
            match self.swapchains.acquire_next_image(chain.raw, u64::MAX, none, self.acquired) {
                Ok((index, _)) => index,
                Err(vk::Result::ERROR_OUT_OF_DATE_KHR) => {
                    self.chain = None;
                    return Ok(None);
                }
                Err(result) => return Err(fail("vkAcquireNextImageKHR")(result)),
            }
        };
        let fences = [self.acquired];
        // SAFETY: as above.
        unsafe {
            device
                .wait_for_fences(&fences, true, u64::MAX)
                .and_then(|()| device.reset_fences(&fences))
        }
        .map_err(fail("vkWaitForFences"))?;
        let image = HostImage {
            handle: chain.images[index as usize].as_raw(),
            format: chain.format,
            size: chain.size,
            layer: 0,
            before: ImageState::UNDEFINED,
            after: ImageState::PRESENT,
        };
        Ok(Some(Acquired { image, index }))
    }

    /// Shows an image, whose drawing is done.
    pub(crate) fn present(&mut self, acquired: Acquired) -> Result<()> {
        let Some(chain) = &self.chain else { return Ok(()) };
        let shared = &self.gpu.shared;
        let (chains, indices) = ([chain.raw], [acquired.index]);
        let info = vk::PresentInfoKHR::default().swapchains(&chains).image_indices(&indices);
        let presented = {
            let queue = lock(&shared.queue);
            // SAFETY: the queue is locked, and the image acquired.
            unsafe { self.swapchains.queue_present(queue.raw, &info) }
        };
        match presented {
            Ok(false) => Ok(()),
            // The next image has the other size.
            Ok(true) | Err(vk::Result::ERROR_OUT_OF_DATE_KHR) => {
                self.drop_chain();
                Ok(())
            }
            Err(result) => Err(shared.error("vkQueuePresentKHR", result)),
        }
    }

    fn new_chain(&mut self, size: [u32; 2]) -> Result<Option<Chain>> {
        let shared = &Arc::clone(&self.gpu.shared);
        let Self { surfaces, swapchains, raw, .. } = &*self;
        let fail = |call| move |result| shared.error(call, result);
        let physical = shared.physical;
        // SAFETY: device and surface are live.
        let (able, formats) = unsafe {
            let able = surfaces.get_physical_device_surface_capabilities(physical, *raw);
            (able, surfaces.get_physical_device_surface_formats(physical, *raw))
        };
        let able = able.map_err(fail("vkGetPhysicalDeviceSurfaceCapabilitiesKHR"))?;
        let formats = formats.map_err(fail("vkGetPhysicalDeviceSurfaceFormatsKHR"))?;
        let [width, height] = match able.current_extent {
            vk::Extent2D { width: u32::MAX, .. } => size,
            vk::Extent2D { width, height } => [width, height],
        };
        if width == 0 || height == 0 {
            self.drop_chain();
            return Ok(None);
        }
        let usage = vk::ImageUsageFlags::TRANSFER_DST | vk::ImageUsageFlags::TRANSFER_SRC;
        let usage = usage & able.supported_usage_flags;
        let wanted = [vk::Format::B8G8R8A8_UNORM, vk::Format::R8G8B8A8_UNORM];
        let format = formats.iter().find(|own| wanted.contains(&own.format));
        let known = format.and_then(|own| ImageFormat::from_vulkan(own.format.as_raw()));
        let (Some(format), Some(known), true) =
            (format, known, usage.contains(vk::ImageUsageFlags::TRANSFER_DST))
        else {
            let problem = "the window has no images of 8 bits that are copied to";
            return Err(Error::NoDevice(problem.to_owned()));
        };
        let most = if able.max_image_count == 0 { u32::MAX } else { able.max_image_count };
        let former = self.chain.as_ref().map_or_else(vk::SwapchainKHR::null, |own| own.raw);
        let info = vk::SwapchainCreateInfoKHR::default()
            .surface(*raw)
            .min_image_count(3.clamp(able.min_image_count, most))
            .image_format(format.format)
            .image_color_space(format.color_space)
            .image_extent(vk::Extent2D { width, height })
            .image_array_layers(1)
            .image_usage(usage)
            .pre_transform(able.current_transform)
            .composite_alpha(vk::CompositeAlphaFlagsKHR::OPAQUE)
            .present_mode(vk::PresentModeKHR::FIFO)
            .clipped(true)
            .old_swapchain(former);
        // SAFETY: `info` points at live locals; every frame of the former chain is done.
        let made = unsafe { swapchains.create_swapchain(&info, None) };
        let made = made.map_err(fail("vkCreateSwapchainKHR"))?;
        // SAFETY: the chain was just created.
        let images = unsafe { swapchains.get_swapchain_images(made) };
        self.drop_chain();
        let images = images.map_err(fail("vkGetSwapchainImagesKHR"))?;
        Ok(Some(Chain { raw: made, images, format: known, size: [width, height] }))
    }

    /// Every frame of it is done.
    fn drop_chain(&mut self) {
        if let Some(chain) = self.chain.take() {
            // SAFETY: frames are waited for before they are presented.
            unsafe { self.swapchains.destroy_swapchain(chain.raw, None) };
        }
    }
}

impl Drop for Surface {
    fn drop(&mut self) {
        self.drop_chain();
        let Shared { device, .. } = &*self.gpu.shared;
        // SAFETY: nothing of the surface is in use; destroying a null fence does nothing.
        unsafe {
            device.destroy_fence(self.acquired, None);
            self.surfaces.destroy_surface(self.raw, None);
        }
    }
}
