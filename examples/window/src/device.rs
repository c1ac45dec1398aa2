//! The device of the host, as any application has one, with what the library asks for.

use std::error::Error;
use std::ffi::{CStr, c_char, c_void};
use std::sync::atomic::{AtomicU32, Ordering};

use nightsplat::ash::vk::Handle as _;
use nightsplat::ash::{self, ext, khr, vk};
use nightsplat::{FeatureStructs, HostDevice, require_features};
use winit::raw_window_handle::{HasDisplayHandle as _, HasWindowHandle as _};
use winit::window::Window;

/// The messages of the validation layers so far.
static MESSAGES: AtomicU32 = AtomicU32::new(0);

/// Instance, surface, device, one queue that draws, computes and presents, and the timeline of the frames.
pub(crate) struct Device {
    entry: ash::Entry,
    instance: ash::Instance,
    debug: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    pub(crate) surfaces: khr::surface::Instance,
    pub(crate) surface: vk::SurfaceKHR,
    pub(crate) physical: vk::PhysicalDevice,
    family: u32,
    extensions: Vec<&'static CStr>,
    pub(crate) raw: ash::Device,
    pub(crate) swapchains: khr::swapchain::Device,
    pub(crate) queue: vk::Queue,
    pub(crate) pool: vk::CommandPool,
    /// Reaches the number of each frame.
    pub(crate) frames: vk::Semaphore,
}

impl Device {
    /// The first device that presents to the window.
    pub(crate) fn new(window: &Window, validates: bool) -> Result<Self, Box<dyn Error>> {
        let (display, handle) =
            (window.display_handle()?.as_raw(), window.window_handle()?.as_raw());
        // SAFETY: every create info points at live locals; the entry is kept as long as the instance.
        unsafe {
            let entry = ash::Entry::load()?;
            let instance =
                instance(&entry, ash_window::enumerate_required_extensions(display)?, validates)?;
            let debug = validates.then(|| messenger(&entry, &instance)).transpose()?;
            let surfaces = khr::surface::Instance::new(&entry, &instance);
            let surface = ash_window::create_surface(&entry, &instance, display, handle, None)?;
            let (physical, family) = presenting(&instance, &surfaces, surface)?;
            let has_push_descriptors = instance
                .enumerate_device_extension_properties(physical)?
                .iter()
                .any(|offered| offered.extension_name_as_c_str() == Ok(khr::push_descriptor::NAME));
            let queues = [vk::DeviceQueueCreateInfo::default()
                .queue_family_index(family)
                .queue_priorities(&[1.0])];
            let mut extensions = vec![khr::swapchain::NAME];
            if has_push_descriptors {
                extensions.push(khr::push_descriptor::NAME);
            }
            let names: Vec<_> = extensions.iter().map(|name| name.as_ptr()).collect();
            // The host's features, and the library's.
            let mut vulkan13 =
                vk::PhysicalDeviceVulkan13Features::default().dynamic_rendering(true);
            let mut info = vk::DeviceCreateInfo::default()
                .queue_create_infos(&queues)
                .enabled_extension_names(&names)
                .push_next(&mut vulkan13);
            let mut structs = FeatureStructs::default();
            require_features((&raw mut info).cast(), &mut structs, &[]);
            let raw = instance.create_device(physical, &info, None)?;
            let pool = vk::CommandPoolCreateInfo::default()
                .queue_family_index(family)
                .flags(vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER);
            let mut kind =
                vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
            let frames = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
            Ok(Self {
                queue: raw.get_device_queue(family, 0),
                pool: raw.create_command_pool(&pool, None)?,
                frames: raw.create_semaphore(&frames, None)?,
                swapchains: khr::swapchain::Device::new(&instance, &raw),
                entry,
                instance,
                debug,
                surfaces,
                surface,
                physical,
                family,
                extensions,
                raw,
            })
        }
    }

    /// As the library sees it. It records and never submits, so it is lent no queue.
    pub(crate) fn lend(&self) -> HostDevice<'_> {
        HostDevice {
            get_instance_proc_addr: self.entry.static_fn().get_instance_proc_addr as *const c_void,
            instance: self.instance.handle().as_raw(),
            physical_device: self.physical.as_raw(),
            device: self.raw.handle().as_raw(),
            queue_family: self.family,
            is_record_only: true,
            extensions: &self.extensions,
            names_objects: self.debug.is_some(),
            frames: self.frames.as_raw(),
            ..HostDevice::default()
        }
    }

    pub(crate) fn allocate(
        &self,
        needed: vk::MemoryRequirements,
        flags: vk::MemoryPropertyFlags,
    ) -> Result<vk::DeviceMemory, Box<dyn Error>> {
        // SAFETY: the device is live.
        unsafe {
            let supported = self.instance.get_physical_device_memory_properties(self.physical);
            let suits = |&i: &u32| {
                needed.memory_type_bits >> i & 1 == 1
                    && supported.memory_types[i as usize].property_flags.contains(flags)
            };
            let index = (0..supported.memory_type_count).find(suits).ok_or("no such memory")?;
            let info = vk::MemoryAllocateInfo::default()
                .allocation_size(needed.size)
                .memory_type_index(index);
            Ok(self.raw.allocate_memory(&info, None)?)
        }
    }

    /// Waits until a frame is done; 0 is none.
    pub(crate) fn wait_frame(&self, number: u64) -> Result<(), vk::Result> {
        let (semaphores, values) = ([self.frames], [number]);
        let info = vk::SemaphoreWaitInfo::default().semaphores(&semaphores).values(&values);
        // SAFETY: the semaphore is live.
        unsafe { self.raw.wait_semaphores(&info, u64::MAX) }
    }

    /// Records the change of an image from one use to another.
    pub(crate) fn change(
        &self,
        commands: vk::CommandBuffer,
        image: vk::Image,
        aspect: vk::ImageAspectFlags,
        [from, to]: [(vk::ImageLayout, vk::PipelineStageFlags2, vk::AccessFlags2); 2],
    ) {
        let range =
            vk::ImageSubresourceRange::default().aspect_mask(aspect).level_count(1).layer_count(1);
        let barrier = [vk::ImageMemoryBarrier2::default()
            .image(image)
            .subresource_range(range)
            .src_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
            .dst_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
            .old_layout(from.0)
            .src_stage_mask(from.1)
            .src_access_mask(from.2)
            .new_layout(to.0)
            .dst_stage_mask(to.1)
            .dst_access_mask(to.2)];
        let info = vk::DependencyInfo::default().image_memory_barriers(&barrier);
        // SAFETY: the command buffer is recording, the image is live.
        unsafe { self.raw.cmd_pipeline_barrier2(commands, &info) };
    }

    /// Destroys everything; returns the number of validation messages.
    pub(crate) fn destroy(self) -> u32 {
        // SAFETY: nothing is in flight, and nothing made from the device is left.
        unsafe {
            self.raw.destroy_semaphore(self.frames, None);
            self.raw.destroy_command_pool(self.pool, None);
            self.raw.destroy_device(None);
            self.surfaces.destroy_surface(self.surface, None);
            if let Some((debug, messenger)) = &self.debug {
                debug.destroy_debug_utils_messenger(*messenger, None);
            }
            self.instance.destroy_instance(None);
        }
        MESSAGES.load(Ordering::Relaxed)
    }
}

/// # Safety
/// The names in `window` are valid.
unsafe fn instance(
    entry: &ash::Entry,
    window: &[*const c_char],
    validates: bool,
) -> Result<ash::Instance, vk::Result> {
    let app = vk::ApplicationInfo::default().api_version(vk::API_VERSION_1_3);
    let mut extensions = window.to_vec();
    let mut layers = vec![];
    if validates {
        layers.push(c"VK_LAYER_KHRONOS_validation".as_ptr());
        extensions.push(ext::debug_utils::NAME.as_ptr());
        extensions.push(ext::validation_features::NAME.as_ptr());
    }
    let checks = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
    let mut checks = vk::ValidationFeaturesEXT::default().enabled_validation_features(&checks);
    let mut info = vk::InstanceCreateInfo::default()
        .application_info(&app)
        .enabled_extension_names(&extensions)
        .enabled_layer_names(&layers);
    if validates {
        info = info.push_next(&mut checks);
    }
    // SAFETY: all pointers are of live locals.
    unsafe { entry.create_instance(&info, None) }
}

/// # Safety
/// The instance has the extension.
unsafe fn messenger(
    entry: &ash::Entry,
    instance: &ash::Instance,
) -> Result<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT), vk::Result> {
    let debug = ext::debug_utils::Instance::new(entry, instance);
    let severities = vk::DebugUtilsMessageSeverityFlagsEXT::ERROR
        | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING;
    let info = vk::DebugUtilsMessengerCreateInfoEXT::default()
        .message_severity(severities)
        .message_type(vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION)
        .pfn_user_callback(Some(on_message));
    // SAFETY: the callback outlives the instance.
    let messenger = unsafe { debug.create_debug_utils_messenger(&info, None) }?;
    Ok((debug, messenger))
}

unsafe extern "system" fn on_message(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    _: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    _: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the layer passes a message.
    let message = unsafe { CStr::from_ptr((*data).p_message) };
    eprintln!("validation: {}", message.to_string_lossy());
    MESSAGES.fetch_add(1, Ordering::Relaxed);
    vk::FALSE
}

/// The first device with a family that does everything.
///
/// # Safety
/// The surface is live.
unsafe fn presenting(
    instance: &ash::Instance,
    surfaces: &khr::surface::Instance,
    surface: vk::SurfaceKHR,
) -> Result<(vk::PhysicalDevice, u32), Box<dyn Error>> {
    let does_both = vk::QueueFlags::COMPUTE | vk::QueueFlags::GRAPHICS;
    // SAFETY: instance and surface are live.
    unsafe {
        for physical in instance.enumerate_physical_devices()? {
            let families = instance.get_physical_device_queue_family_properties(physical);
            for (index, family) in (0..).zip(families) {
                if family.queue_flags.contains(does_both)
                    && surfaces.get_physical_device_surface_support(physical, index, surface)?
                {
                    return Ok((physical, index));
                }
            }
        }
    }
    Err("no Vulkan device presents to this window".into())
}
