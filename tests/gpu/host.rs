//! A host application with a Vulkan device of its own, whose validation messages are counted.

#![expect(unsafe_code, reason = "plays a host application, which calls Vulkan itself")]

use std::ffi::{CStr, c_void};
use std::sync::Mutex;

use ash::vk::Handle as _;
use ash::{ext, khr, vk};
use nightsplat::gpu::testing::gpu;
use nightsplat::gpu::{
    FeatureStructs, Gpu, HostDevice, HostImage, ImageFormat, ImageState, require_features,
};

/// The host: instance, device and queue with validation, synchronization validation and best practices.
pub(crate) struct Host {
    entry: ash::Entry,
    instance: ash::Instance,
    debug: ext::debug_utils::Instance,
    messenger: vk::DebugUtilsMessengerEXT,
    messages: Box<Mutex<Vec<String>>>,
    physical: vk::PhysicalDevice,
    pub(crate) family: u32,
    pub(crate) extensions: &'static [&'static CStr],
    pub(crate) device: ash::Device,
    pub(crate) queue: vk::Queue,
    pool: vk::CommandPool,
    /// Reaches the number of each frame that is submitted.
    timeline: vk::Semaphore,
}

/// A buffer of words that the host reads and writes through a mapping.
pub(crate) struct Memory {
    pub(crate) buffer: vk::Buffer,
    memory: vk::DeviceMemory,
    mapped: *mut u32,
    pub(crate) len: usize,
}

/// An image of the host's, with its memory.
pub(crate) struct Picture {
    pub(crate) image: vk::Image,
    memory: vk::DeviceMemory,
    pub(crate) format: ImageFormat,
    pub(crate) size: [u32; 2],
}

impl Picture {
    /// As it is lent: between these states.
    pub(crate) fn lent(&self, before: ImageState, after: ImageState) -> HostImage {
        let Self { image, format, size, .. } = *self;
        HostImage { handle: image.as_raw(), format, size, layer: 0, before, after }
    }
}

impl Memory {
    pub(crate) fn size(&self) -> u64 {
        4 * self.len as u64
    }

    pub(crate) fn write(&self, words: &[u32]) {
        assert!(words.len() <= self.len);
        // SAFETY: mapped and coherent, this long; no submission that uses it is in flight.
        unsafe { std::ptr::copy_nonoverlapping(words.as_ptr(), self.mapped, words.len()) }
    }

    pub(crate) fn read(&self) -> Vec<u32> {
        // SAFETY: as above; every submission that writes it was waited for.
        unsafe { std::slice::from_raw_parts(self.mapped, self.len) }.to_vec()
    }
}

impl Host {
    /// With these device extensions.
    pub(crate) fn new(extensions: &'static [&'static CStr]) -> Self {
        Self::of_version(vk::API_VERSION_1_3, extensions)
    }

    /// Whose instance is of a Vulkan version.
    pub(crate) fn of_version(version: u32, extensions: &'static [&'static CStr]) -> Self {
        let messages = Box::new(Mutex::new(vec![]));
        let messenger_info = messenger_info(&messages);
        // SAFETY: every create info points at live locals; the messages are boxed and outlive the instance.
        unsafe {
            let entry = ash::Entry::load().unwrap();
            let instance = instance(&entry, version, messenger_info);
            let debug = ext::debug_utils::Instance::new(&entry, &instance);
            let messenger = debug.create_debug_utils_messenger(&messenger_info, None).unwrap();
            // The device that the other tests use.
            let name = gpu().properties().name.clone();
            let all = instance.enumerate_physical_devices().unwrap();
            let is_wanted = |physical: &vk::PhysicalDevice| {
                let properties = instance.get_physical_device_properties(*physical);
                properties.device_name_as_c_str().unwrap().to_string_lossy() == name
            };
            let physical = all.into_iter().find(is_wanted).unwrap();
            let families = instance.get_physical_device_queue_family_properties(physical);
            let does_both = vk::QueueFlags::COMPUTE | vk::QueueFlags::GRAPHICS;
            let suits = |f: &vk::QueueFamilyProperties| f.queue_flags.contains(does_both);
            let family = families.iter().position(suits).unwrap() as u32;
            let device = device(&instance, physical, family, version, extensions);
            let pool_info = vk::CommandPoolCreateInfo::default().queue_family_index(family);
            let mut kind =
                vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
            let timeline_info = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
            Self {
                queue: device.get_device_queue(family, 0),
                pool: device.create_command_pool(&pool_info, None).unwrap(),
                timeline: device.create_semaphore(&timeline_info, None).unwrap(),
                entry,
                instance,
                debug,
                messenger,
                messages,
                physical,
                family,
                extensions,
                device,
            }
        }
    }

    /// The device as it is lent, queue included; the host tells of frames by its timeline.
    pub(crate) fn lend(&self) -> HostDevice<'static> {
        HostDevice {
            get_instance_proc_addr: self.entry.static_fn().get_instance_proc_addr as *const c_void,
            instance: self.instance.handle().as_raw(),
            physical_device: self.physical.as_raw(),
            device: self.device.handle().as_raw(),
            queue: self.queue.as_raw(),
            queue_family: self.family,
            extensions: self.extensions,
            frames: self.timeline.as_raw(),
            names_objects: true,
            ..HostDevice::default()
        }
    }

    /// The loader's function.
    pub(crate) fn loader_function(&self) -> vk::PFN_vkGetInstanceProcAddr {
        self.entry.static_fn().get_instance_proc_addr
    }

    /// The same without the queue.
    pub(crate) fn lend_to_record(&self) -> HostDevice<'static> {
        HostDevice { queue: 0, is_record_only: true, ..self.lend() }
    }

    pub(crate) fn memory(&self, len: usize) -> Memory {
        let usage = vk::BufferUsageFlags::TRANSFER_DST | vk::BufferUsageFlags::TRANSFER_SRC;
        let info = vk::BufferCreateInfo::default().size(4 * len as u64).usage(usage);
        let flags = vk::MemoryPropertyFlags::HOST_VISIBLE | vk::MemoryPropertyFlags::HOST_COHERENT;
        // SAFETY: the device is live; the buffer is bound once to memory of a type that suits it.
        unsafe {
            let buffer = self.device.create_buffer(&info, None).unwrap();
            let needed = self.device.get_buffer_memory_requirements(buffer);
            let memory = self.allocate(needed, flags);
            self.device.bind_buffer_memory(buffer, memory, 0).unwrap();
            let mapped = self.device.map_memory(memory, 0, vk::WHOLE_SIZE, Default::default());
            Memory { buffer, memory, mapped: mapped.unwrap().cast(), len }
        }
    }

    fn allocate(
        &self,
        needed: vk::MemoryRequirements,
        flags: vk::MemoryPropertyFlags,
    ) -> vk::DeviceMemory {
        // SAFETY: the device is live.
        unsafe {
            let supported = self.instance.get_physical_device_memory_properties(self.physical);
            let suits = |&i: &u32| {
                needed.memory_type_bits >> i & 1 == 1
                    && supported.memory_types[i as usize].property_flags.contains(flags)
            };
            let index = (0..supported.memory_type_count).find(suits).unwrap();
            let info = vk::MemoryAllocateInfo::default()
                .allocation_size(needed.size)
                .memory_type_index(index);
            self.device.allocate_memory(&info, None).unwrap()
        }
    }

    /// An image with two layers that is copied from and to; `None` where the device has no such images.
    pub(crate) fn picture(&self, format: ImageFormat, size: [u32; 2]) -> Option<Picture> {
        let raw = vulkan(format);
        let [width, height] = size;
        let attached = match aspects(format) {
            vk::ImageAspectFlags::COLOR => vk::ImageUsageFlags::COLOR_ATTACHMENT,
            _ => vk::ImageUsageFlags::DEPTH_STENCIL_ATTACHMENT,
        };
        let usage = vk::ImageUsageFlags::TRANSFER_SRC
            | vk::ImageUsageFlags::TRANSFER_DST
            | vk::ImageUsageFlags::SAMPLED
            | attached;
        let tiling = vk::ImageTiling::OPTIMAL;
        let info = vk::ImageCreateInfo::default()
            .image_type(vk::ImageType::TYPE_2D)
            .format(raw)
            .extent(vk::Extent3D { width, height, depth: 1 })
            .mip_levels(1)
            .array_layers(2)
            .samples(vk::SampleCountFlags::TYPE_1)
            .tiling(tiling)
            .usage(usage);
        // SAFETY: the device is live; the image is bound once to memory of a type that suits it.
        unsafe {
            self.instance
                .get_physical_device_image_format_properties(
                    self.physical,
                    raw,
                    vk::ImageType::TYPE_2D,
                    tiling,
                    usage,
                    Default::default(),
                )
                .is_ok()
                .then_some(())?;
            let image = self.device.create_image(&info, None).unwrap();
            let needed = self.device.get_image_memory_requirements(image);
            let memory = self.allocate(needed, vk::MemoryPropertyFlags::DEVICE_LOCAL);
            self.device.bind_image_memory(image, memory, 0).unwrap();
            Some(Picture { image, memory, format, size })
        }
    }

    /// Records a copy between a layer of a picture and memory. The layer is in the layout of a transfer's source or
    /// target before and after.
    pub(crate) fn copy(
        &self,
        commands: vk::CommandBuffer,
        picture: &Picture,
        layer: u32,
        memory: &Memory,
        is_upload: bool,
    ) {
        let copied = vk::ImageAspectFlags::COLOR | vk::ImageAspectFlags::DEPTH;
        let aspect = aspects(picture.format) & copied;
        let [width, height] = picture.size;
        let layers = vk::ImageSubresourceLayers::default()
            .aspect_mask(aspect)
            .base_array_layer(layer)
            .layer_count(1);
        let region = [vk::BufferImageCopy::default()
            .image_subresource(layers)
            .image_extent(vk::Extent3D { width, height, depth: 1 })];
        let (image, buffer, device) = (picture.image, memory.buffer, &self.device);
        // SAFETY: recording; image and buffer are live and hold the region.
        unsafe {
            match is_upload {
                true => device.cmd_copy_buffer_to_image(
                    commands,
                    buffer,
                    image,
                    vk::ImageLayout::TRANSFER_DST_OPTIMAL,
                    &region,
                ),
                false => device.cmd_copy_image_to_buffer(
                    commands,
                    image,
                    vk::ImageLayout::TRANSFER_SRC_OPTIMAL,
                    buffer,
                    &region,
                ),
            }
        }
    }

    /// Records the change of both layers of a picture from one state to another.
    pub(crate) fn barrier(
        &self,
        commands: vk::CommandBuffer,
        picture: &Picture,
        from: ImageState,
        to: ImageState,
    ) {
        let range = vk::ImageSubresourceRange::default()
            .aspect_mask(aspects(picture.format))
            .level_count(1)
            .layer_count(2);
        let barrier = [vk::ImageMemoryBarrier2::default()
            .image(picture.image)
            .subresource_range(range)
            .old_layout(vk::ImageLayout::from_raw(from.layout))
            .new_layout(vk::ImageLayout::from_raw(to.layout))
            .src_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
            .dst_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
            .src_stage_mask(vk::PipelineStageFlags2::from_raw(from.stages))
            .src_access_mask(vk::AccessFlags2::from_raw(from.access))
            .dst_stage_mask(vk::PipelineStageFlags2::from_raw(to.stages))
            .dst_access_mask(vk::AccessFlags2::from_raw(to.access))];
        let info = vk::DependencyInfo::default().image_memory_barriers(&barrier);
        // SAFETY: recording; the image is live.
        unsafe { self.device.cmd_pipeline_barrier2(commands, &info) }
    }

    /// Fills a layer of a picture, which is in no state yet, with words as a copy has them, and leaves both layers in
    /// state `after`.
    pub(crate) fn fill_picture(&self, picture: &Picture, layers: [&[u32]; 2], after: ImageState) {
        let memories = layers.map(|words| {
            let memory = self.memory(words.len());
            memory.write(words);
            memory
        });
        self.submit(|commands| {
            self.barrier(commands, picture, ImageState::UNDEFINED, ImageState::TRANSFER_TARGET);
            for (layer, memory) in (0..).zip(&memories) {
                self.copy(commands, picture, layer, memory, true);
            }
            self.barrier(commands, picture, ImageState::TRANSFER_TARGET, after);
        });
        memories.into_iter().for_each(|memory| self.free(memory));
    }

    /// The words of both layers of a picture that is in the state of a transfer's source.
    pub(crate) fn read_picture(&self, picture: &Picture, words: usize) -> [Vec<u32>; 2] {
        [0, 1].map(|layer| self.read_layer(picture, layer, words))
    }

    pub(crate) fn read_layer(&self, picture: &Picture, layer: u32, words: usize) -> Vec<u32> {
        let memory = self.memory(words);
        self.submit(|commands| self.copy(commands, picture, layer, &memory, false));
        let words = memory.read();
        self.free(memory);
        words
    }

    /// Submits nothing, by `submit_within`, and waits.
    pub(crate) fn submit_empty(&self, submit_within: impl FnOnce(&dyn Fn())) {
        // SAFETY: the fence is live until it was waited for; the caller holds the queue's lock.
        unsafe {
            let fence = self.device.create_fence(&Default::default(), None).unwrap();
            submit_within(&|| self.device.queue_submit(self.queue, &[], fence).unwrap());
            self.device.wait_for_fences(&[fence], true, u64::MAX).unwrap();
            self.device.destroy_fence(fence, None);
        }
    }

    pub(crate) fn fill(&self, memory: &Memory, word: u32) {
        self.submit(|commands| {
            // SAFETY: the command buffer is recording, the buffer is live.
            unsafe {
                self.device.cmd_fill_buffer(commands, memory.buffer, 0, vk::WHOLE_SIZE, word);
            }
        });
    }

    pub(crate) fn free(&self, memory: Memory) {
        // SAFETY: every submission that uses it was waited for.
        unsafe {
            self.device.destroy_buffer(memory.buffer, None);
            self.device.free_memory(memory.memory, None);
        }
    }

    pub(crate) fn free_picture(&self, picture: Picture) {
        // SAFETY: as above.
        unsafe {
            self.device.destroy_image(picture.image, None);
            self.device.free_memory(picture.memory, None);
        }
    }

    /// A command buffer that is recording.
    pub(crate) fn begin(&self) -> vk::CommandBuffer {
        let allocate = vk::CommandBufferAllocateInfo::default()
            .command_pool(self.pool)
            .command_buffer_count(1);
        let once = vk::CommandBufferBeginInfo::default()
            .flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: the pool is live and used by this thread alone.
        unsafe {
            let commands = self.device.allocate_command_buffers(&allocate).unwrap()[0];
            self.device.begin_command_buffer(commands, &once).unwrap();
            commands
        }
    }

    /// Ends and submits a frame; the timeline reaches its number when it is done.
    pub(crate) fn submit_frame(&self, commands: vk::CommandBuffer, frame: u64) {
        let buffers = [vk::CommandBufferSubmitInfo::default().command_buffer(commands)];
        let signal = [vk::SemaphoreSubmitInfo::default()
            .semaphore(self.timeline)
            .value(frame)
            .stage_mask(vk::PipelineStageFlags2::ALL_TRANSFER)];
        let info = [vk::SubmitInfo2::default()
            .command_buffer_infos(&buffers)
            .signal_semaphore_infos(&signal)];
        // SAFETY: the command buffer is recorded, and not touched before the frame is waited for.
        unsafe {
            self.device.end_command_buffer(commands).unwrap();
            self.device.queue_submit2(self.queue, &info, vk::Fence::null()).unwrap();
        }
    }

    pub(crate) fn wait_frame(&self, frame: u64) {
        let (semaphores, values) = ([self.timeline], [frame]);
        let info = vk::SemaphoreWaitInfo::default().semaphores(&semaphores).values(&values);
        // SAFETY: the semaphore is live.
        unsafe { self.device.wait_semaphores(&info, u64::MAX).unwrap() }
    }

    /// Records, submits and waits.
    pub(crate) fn submit(&self, record: impl FnOnce(vk::CommandBuffer)) {
        let (device, commands) = (&self.device, self.begin());
        record(commands);
        let visible = [vk::MemoryBarrier::default()
            .src_access_mask(vk::AccessFlags::TRANSFER_WRITE)
            .dst_access_mask(vk::AccessFlags::HOST_READ)];
        let (from, to) = (vk::PipelineStageFlags::TRANSFER, vk::PipelineStageFlags::HOST);
        let none = Default::default();
        // SAFETY: all objects are live and used by this thread alone, until the fence says that they are done.
        unsafe {
            device.cmd_pipeline_barrier(commands, from, to, none, &visible, &[], &[]);
            device.end_command_buffer(commands).unwrap();
            let fence = device.create_fence(&Default::default(), None).unwrap();
            let commands = [commands];
            let submit = [vk::SubmitInfo::default().command_buffers(&commands)];
            device.queue_submit(self.queue, &submit, fence).unwrap();
            device.wait_for_fences(&[fence], true, u64::MAX).unwrap();
            device.destroy_fence(fence, None);
            device.free_command_buffers(self.pool, &commands);
        }
    }

    /// Takes everything down, and fails on any message of validation, to the very end.
    pub(crate) fn destroy(self) {
        // SAFETY: nothing is in flight, and the host's own objects are destroyed before their parents.
        unsafe {
            self.device.destroy_semaphore(self.timeline, None);
            self.device.destroy_command_pool(self.pool, None);
            self.device.destroy_device(None);
            self.debug.destroy_debug_utils_messenger(self.messenger, None);
            self.instance.destroy_instance(None);
        }
        let messages = self.messages.into_inner().unwrap();
        assert!(messages.is_empty(), "validation: {messages:#?}");
    }
}

/// Runs `test` on a host and its record-only device, and fails on any validation message.
pub(crate) fn with_host(test: impl FnOnce(&Host, &Gpu)) {
    let host = Host::new(usual_extensions());
    {
        // SAFETY: the handles are the host's own and outlive `gpu`.
        let gpu = unsafe { Gpu::from_host(host.lend_to_record()) }.unwrap();
        test(&host, &gpu);
    }
    host.destroy();
}

/// The aspects of images of a format.
fn aspects(format: ImageFormat) -> vk::ImageAspectFlags {
    let depth = vk::ImageAspectFlags::DEPTH;
    match format {
        ImageFormat::D32FloatS8 | ImageFormat::D24UnormS8 => depth | vk::ImageAspectFlags::STENCIL,
        ImageFormat::D32Float | ImageFormat::D24UnormX8 | ImageFormat::D16Unorm => depth,
        _ => vk::ImageAspectFlags::COLOR,
    }
}

/// Vulkan's constant of a format.
pub(crate) fn vulkan(format: ImageFormat) -> vk::Format {
    match format {
        ImageFormat::Rgba16Float => vk::Format::R16G16B16A16_SFLOAT,
        ImageFormat::Rgba32Float => vk::Format::R32G32B32A32_SFLOAT,
        ImageFormat::B10G11R11Float => vk::Format::B10G11R11_UFLOAT_PACK32,
        ImageFormat::A2B10G10R10Unorm => vk::Format::A2B10G10R10_UNORM_PACK32,
        ImageFormat::A2R10G10B10Unorm => vk::Format::A2R10G10B10_UNORM_PACK32,
        ImageFormat::Rgba8Unorm => vk::Format::R8G8B8A8_UNORM,
        ImageFormat::Rgba8Srgb => vk::Format::R8G8B8A8_SRGB,
        ImageFormat::Bgra8Unorm => vk::Format::B8G8R8A8_UNORM,
        ImageFormat::Bgra8Srgb => vk::Format::B8G8R8A8_SRGB,
        ImageFormat::Rg16Float => vk::Format::R16G16_SFLOAT,
        ImageFormat::Rg32Float => vk::Format::R32G32_SFLOAT,
        ImageFormat::R32Float => vk::Format::R32_SFLOAT,
        ImageFormat::D32Float => vk::Format::D32_SFLOAT,
        ImageFormat::D32FloatS8 => vk::Format::D32_SFLOAT_S8_UINT,
        ImageFormat::D24UnormX8 => vk::Format::X8_D24_UNORM_PACK32,
        ImageFormat::D24UnormS8 => vk::Format::D24_UNORM_S8_UINT,
        ImageFormat::D16Unorm => vk::Format::D16_UNORM,
    }
}

/// # Safety
/// The messages that `messenger_info` points at outlive the instance.
unsafe fn instance(
    entry: &ash::Entry,
    version: u32,
    mut messenger_info: vk::DebugUtilsMessengerCreateInfoEXT<'_>,
) -> ash::Instance {
    let app = vk::ApplicationInfo::default().api_version(version);
    let layers = [c"VK_LAYER_KHRONOS_validation".as_ptr()];
    let extensions = [ext::debug_utils::NAME.as_ptr(), ext::validation_features::NAME.as_ptr()];
    let checks = [
        vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION,
        vk::ValidationFeatureEnableEXT::BEST_PRACTICES,
    ];
    let mut features = vk::ValidationFeaturesEXT::default().enabled_validation_features(&checks);
    let info = vk::InstanceCreateInfo::default()
        .application_info(&app)
        .enabled_layer_names(&layers)
        .enabled_extension_names(&extensions)
        .push_next(&mut features)
        .push_next(&mut messenger_info);
    // SAFETY: `info` points at live locals, and the rest is as the caller promises.
    unsafe { entry.create_instance(&info, None) }.unwrap()
}

/// # Safety
/// The handles are live.
unsafe fn device(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    family: u32,
    version: u32,
    extensions: &[&CStr],
) -> ash::Device {
    let priorities = [1.0];
    let queues = [vk::DeviceQueueCreateInfo::default()
        .queue_family_index(family)
        .queue_priorities(&priorities)];
    let extensions: Vec<_> = extensions.iter().map(|name| name.as_ptr()).collect();
    let mut rendering =
        vk::PhysicalDeviceDynamicRenderingFeatures::default().dynamic_rendering(true);
    let mut info = vk::DeviceCreateInfo::default()
        .queue_create_infos(&queues)
        .enabled_extension_names(&extensions);
    if version >= vk::API_VERSION_1_3 {
        info = info.push_next(&mut rendering);
    }
    let mut structs = FeatureStructs::default();
    // SAFETY: `info` points at live locals.
    unsafe {
        require_features((&raw mut info).cast(), &mut structs, &[]);
        instance.create_device(physical, &info, None).unwrap()
    }
}

/// Extensions that make recording faster, where the device has them.
pub(crate) fn usual_extensions() -> &'static [&'static CStr] {
    match gpu().properties().has_push_descriptors {
        true => &[khr::push_descriptor::NAME],
        false => &[],
    }
}

/// Best practices that do not apply: glslang writes the former of both decorations of a workgroup's size, a test
/// allocates little, and debugs.
const ALLOWED: [&str; 4] = [
    "BestPractices-SpirvDeprecated_WorkgroupSize",
    "BestPractices-vkAllocateMemory-small-allocation",
    "BestPractices-vkBindMemory-small-dedicated-allocation",
    "BestPractices-vkCreateInstance-specialuse-extension-debugging",
];

fn messenger_info(messages: &Mutex<Vec<String>>) -> vk::DebugUtilsMessengerCreateInfoEXT<'static> {
    let severity = vk::DebugUtilsMessageSeverityFlagsEXT::ERROR
        | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING;
    let kinds = vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION
        | vk::DebugUtilsMessageTypeFlagsEXT::PERFORMANCE;
    vk::DebugUtilsMessengerCreateInfoEXT::default()
        .message_severity(severity)
        .message_type(kinds)
        .pfn_user_callback(Some(on_message))
        .user_data(std::ptr::from_ref(messages).cast_mut().cast())
}

unsafe extern "system" fn on_message(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    _: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    messages: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the loader passes valid callback data with a NUL-terminated message, and our own user data.
    let (message, messages) = unsafe {
        let message = CStr::from_ptr((*data).p_message).to_string_lossy().into_owned();
        (message, &*messages.cast::<Mutex<Vec<String>>>())
    };
    if !ALLOWED.iter().any(|name| message.contains(name)) {
        messages.lock().unwrap().push(message);
    }
    vk::FALSE
}
