//! A host application with its own Vulkan lends its device, and gets it back unchanged.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]
#![expect(unsafe_code, reason = "plays a host application, which calls Vulkan itself")]

use std::ffi::{CStr, c_void};
use std::sync::Mutex;

use ash::vk::Handle as _;
use ash::{ext, khr, vk};
use glam::{DAffine3, DVec2};
use nightsplat::base::random::Stream;
use nightsplat::camera::{Camera, CameraModel};
use nightsplat::gpu::testing::gpu;
use nightsplat::gpu::{Gpu, HostDevice, required_device_features};
use nightsplat::photographs::image::Image;
use nightsplat::splats::render::{RenderOptions, RenderSettings, Renderer};
use nightsplat::splats::scene::Gaussians;

#[test]
fn a_borrowed_device_renders_the_same_and_is_returned_unchanged() {
    // A device without the extension has its descriptors in sets; the bits are the same.
    lend_and_take_back(&[]);
    if gpu().properties().has_push_descriptors {
        lend_and_take_back(&[khr::push_descriptor::NAME]);
    }
}

fn lend_and_take_back(extensions: &[&CStr]) {
    let own = render(&gpu());
    assert!(own.data.iter().any(|&value| value > 0.5), "nothing is seen");

    let host = Host::new(extensions);
    let mut memory = host.memory(own.data.len());
    host.fill(&memory, 0xcafe_f00d);

    // SAFETY: the handles are the host's own and outlive `lent`; nothing else uses the queue meanwhile.
    let lent = unsafe { Gpu::from_host(host.lend()) }.unwrap();
    assert_same("our own submissions", &render(&lent), &own);
    assert_eq!(host.read(&memory), vec![0xcafe_f00d; own.data.len()], "the host's memory changed");
    render_into(&host, &lent, &mut memory);
    let data = host.read(&memory).into_iter().map(f32::from_bits).collect();
    assert_same("recorded into the host's command buffer", &Image { data, ..own.clone() }, &own);
    drop(lent);

    host.fill(&memory, 0x1234_5678);
    assert_eq!(host.read(&memory), vec![0x1234_5678; own.data.len()], "the device is not alive");
    host.free(memory);
    // Objects that the library did not destroy would be reported when the host destroys its device.
    let messages = host.destroy();
    assert!(messages.is_empty(), "validation: {messages:#?}");
}

#[test]
fn a_host_without_a_loader_function_is_refused() {
    let host = HostDevice {
        get_instance_proc_addr: std::ptr::null(),
        instance: 0,
        physical_device: 0,
        device: 0,
        queue: 0,
        queue_family: 0,
    };
    // SAFETY: the first handle, which is null, is refused before any is used.
    let message = unsafe { Gpu::from_host(host) }.unwrap_err().to_string();
    assert!(message.contains("get_instance_proc_addr"), "{message}");
}

fn assert_same(what: &str, actual: &Image, expected: &Image) {
    let bits = |image: &Image| image.data.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
    let differing = bits(actual).iter().zip(bits(expected)).filter(|(a, b)| **a != *b).count();
    assert_eq!(actual.data.len(), expected.data.len(), "{what}");
    assert_eq!(differing, 0, "{what}: values differ");
}

// ---------------------------------------------------------------------------
// What is rendered

const OPTIONS: RenderOptions = RenderOptions { sh_degree: 0, background: [0.1, 0.2, 0.3] };

fn camera() -> Camera {
    Camera {
        width: 48,
        height: 40,
        focal: DVec2::splat(40.0),
        principal_point: DVec2::new(24.0, 20.0),
        model: CameraModel::Pinhole,
        view_from_world: DAffine3::IDENTITY,
    }
}

/// About two hundred in front of the camera.
fn gaussians() -> Gaussians {
    let mut gaussians = Gaussians::zeros(200, 0);
    let count = gaussians.count;
    for (i, value) in gaussians.parameters.iter_mut().enumerate() {
        let uniform = Stream::new(1, 0).uniform(i as u64) as f32;
        *value = match i / count {
            0 | 1 => 2.0 * uniform - 1.0,
            2 => 2.0 + uniform,
            3..7 => uniform + 0.1,
            7..10 => -3.0 + uniform,
            _ => 2.0 * uniform,
        };
    }
    gaussians
}

fn renderer(gpu: &Gpu) -> Renderer {
    let settings = RenderSettings { shape: 0.into(), ..RenderSettings::default() };
    let mut renderer = Renderer::new(gpu, settings).unwrap();
    renderer.reserve(gaussians().count, [&camera()]).unwrap();
    renderer
}

fn render(gpu: &Gpu) -> Image {
    let on_device = gaussians().upload(gpu).unwrap();
    renderer(gpu).render_image(&on_device, &camera(), &OPTIONS).unwrap()
}

/// Renders within a command buffer that the host begins, continues with a copy to its memory, and submits.
fn render_into(host: &Host, gpu: &Gpu, memory: &mut Memory) {
    let on_device = gaussians().upload(gpu).unwrap();
    // A separate renderer, so that no earlier render is mistaken for this one.
    let mut renderer = renderer(gpu);
    let mut held = None;
    host.submit(|commands| {
        // SAFETY: the command buffer is recording; all objects used live until the host has waited for it.
        let recorded = unsafe {
            gpu.record_into(commands.as_raw(), |pass| {
                // The library cannot tell when the copy is done.
                let message = pass.download(&on_device.parameters).unwrap_err().to_string();
                assert!(message.contains("`parameters`"), "{message}");
                renderer.forward(pass, &on_device, &camera(), &OPTIONS)
            })
        };
        held = Some(recorded.unwrap());
        let region = [vk::BufferCopy { size: memory.size(), ..Default::default() }];
        let render = vk::Buffer::from_raw(renderer.render().handle());
        // SAFETY: both buffers are live and hold `size` bytes.
        unsafe { host.device.cmd_copy_buffer(commands, render, memory.buffer, &region) };
    });
    drop(held);
}

// ---------------------------------------------------------------------------
// The host application

struct Host {
    entry: ash::Entry,
    instance: ash::Instance,
    debug: ext::debug_utils::Instance,
    messenger: vk::DebugUtilsMessengerEXT,
    messages: Box<Mutex<Vec<String>>>,
    physical: vk::PhysicalDevice,
    family: u32,
    device: ash::Device,
    queue: vk::Queue,
    pool: vk::CommandPool,
}

/// A buffer of words that the host reads through a mapping.
struct Memory {
    buffer: vk::Buffer,
    memory: vk::DeviceMemory,
    mapped: *const u32,
    len: usize,
}

impl Memory {
    fn size(&self) -> u64 {
        4 * self.len as u64
    }
}

impl Host {
    fn new(extensions: &[&CStr]) -> Self {
        let messages = Box::new(Mutex::new(vec![]));
        let messenger_info = messenger_info(&messages);
        // SAFETY: every create info points at live locals; the messages are boxed and outlive the instance.
        unsafe {
            let entry = ash::Entry::load().unwrap();
            let instance = instance(&entry, messenger_info);
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
            let has_compute =
                |f: &vk::QueueFamilyProperties| f.queue_flags.contains(vk::QueueFlags::COMPUTE);
            let family = families.iter().position(has_compute).unwrap() as u32;
            let device = device(&instance, physical, family, extensions);
            let pool_info = vk::CommandPoolCreateInfo::default().queue_family_index(family);
            Self {
                queue: device.get_device_queue(family, 0),
                pool: device.create_command_pool(&pool_info, None).unwrap(),
                entry,
                instance,
                debug,
                messenger,
                messages,
                physical,
                family,
                device,
            }
        }
    }

    fn lend(&self) -> HostDevice {
        HostDevice {
            get_instance_proc_addr: self.entry.static_fn().get_instance_proc_addr as *const c_void,
            instance: self.instance.handle().as_raw(),
            physical_device: self.physical.as_raw(),
            device: self.device.handle().as_raw(),
            queue: self.queue.as_raw(),
            queue_family: self.family,
        }
    }

    fn memory(&self, len: usize) -> Memory {
        let usage = vk::BufferUsageFlags::TRANSFER_DST;
        let info = vk::BufferCreateInfo::default().size(4 * len as u64).usage(usage);
        let flags = vk::MemoryPropertyFlags::HOST_VISIBLE | vk::MemoryPropertyFlags::HOST_COHERENT;
        // SAFETY: the device is live; the buffer is bound once to memory of a type that suits it.
        unsafe {
            let buffer = self.device.create_buffer(&info, None).unwrap();
            let needed = self.device.get_buffer_memory_requirements(buffer);
            let supported = self.instance.get_physical_device_memory_properties(self.physical);
            let suits = |&i: &u32| {
                needed.memory_type_bits >> i & 1 == 1
                    && supported.memory_types[i as usize].property_flags.contains(flags)
            };
            let index = (0..supported.memory_type_count).find(suits).unwrap();
            let info = vk::MemoryAllocateInfo::default()
                .allocation_size(needed.size)
                .memory_type_index(index);
            let memory = self.device.allocate_memory(&info, None).unwrap();
            self.device.bind_buffer_memory(buffer, memory, 0).unwrap();
            let mapped = self.device.map_memory(memory, 0, vk::WHOLE_SIZE, Default::default());
            Memory { buffer, memory, mapped: mapped.unwrap().cast(), len }
        }
    }

    fn fill(&self, memory: &Memory, word: u32) {
        self.submit(|commands| {
            // SAFETY: the command buffer is recording, the buffer is live.
            unsafe {
                self.device.cmd_fill_buffer(commands, memory.buffer, 0, vk::WHOLE_SIZE, word);
            }
        });
    }

    fn read(&self, memory: &Memory) -> Vec<u32> {
        // SAFETY: mapped and coherent, `len` words long; every submission that writes it was waited for.
        unsafe { std::slice::from_raw_parts(memory.mapped, memory.len) }.to_vec()
    }

    fn free(&self, memory: Memory) {
        // SAFETY: every submission that uses it was waited for.
        unsafe {
            self.device.destroy_buffer(memory.buffer, None);
            self.device.free_memory(memory.memory, None);
        }
    }

    /// Records, submits and waits.
    fn submit(&self, record: impl FnOnce(vk::CommandBuffer)) {
        let device = &self.device;
        let allocate = vk::CommandBufferAllocateInfo::default()
            .command_pool(self.pool)
            .command_buffer_count(1);
        // SAFETY: all objects are live and used only by this thread, until the fence is signalled.
        unsafe {
            let commands = device.allocate_command_buffers(&allocate).unwrap();
            device.begin_command_buffer(commands[0], &Default::default()).unwrap();
            record(commands[0]);
            let visible = [vk::MemoryBarrier::default()
                .src_access_mask(vk::AccessFlags::TRANSFER_WRITE)
                .dst_access_mask(vk::AccessFlags::HOST_READ)];
            let (from, to) = (vk::PipelineStageFlags::TRANSFER, vk::PipelineStageFlags::HOST);
            let none = Default::default();
            device.cmd_pipeline_barrier(commands[0], from, to, none, &visible, &[], &[]);
            device.end_command_buffer(commands[0]).unwrap();
            let fence = device.create_fence(&Default::default(), None).unwrap();
            let submit = [vk::SubmitInfo::default().command_buffers(&commands)];
            device.queue_submit(self.queue, &submit, fence).unwrap();
            device.wait_for_fences(&[fence], true, u64::MAX).unwrap();
            device.destroy_fence(fence, None);
            device.free_command_buffers(self.pool, &commands);
        }
    }

    /// Destroys everything; returns all validation messages.
    fn destroy(self) -> Vec<String> {
        // SAFETY: nothing is in flight, and the host's own objects are destroyed before their parents.
        unsafe {
            self.device.destroy_command_pool(self.pool, None);
            self.device.destroy_device(None);
            self.debug.destroy_debug_utils_messenger(self.messenger, None);
            self.instance.destroy_instance(None);
        }
        self.messages.into_inner().unwrap()
    }
}

/// # Safety
/// The messages that `messenger_info` points at outlive the instance.
unsafe fn instance(
    entry: &ash::Entry,
    mut messenger_info: vk::DebugUtilsMessengerCreateInfoEXT<'_>,
) -> ash::Instance {
    let app = vk::ApplicationInfo::default().api_version(vk::API_VERSION_1_3);
    let layers = [c"VK_LAYER_KHRONOS_validation".as_ptr()];
    let extensions = [ext::debug_utils::NAME.as_ptr(), ext::validation_features::NAME.as_ptr()];
    let checks = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
    let mut features = vk::ValidationFeaturesEXT::default().enabled_validation_features(&checks);
    let info = vk::InstanceCreateInfo::default()
        .application_info(&app)
        .enabled_layer_names(&layers)
        .enabled_extension_names(&extensions)
        .push_next(&mut features)
        .push_next(&mut messenger_info);
    // SAFETY: `info` points at live locals, and the caller guarantees the rest.
    unsafe { entry.create_instance(&info, None) }.unwrap()
}

/// # Safety
/// The handles are live.
unsafe fn device(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    family: u32,
    extensions: &[&CStr],
) -> ash::Device {
    let priorities = [1.0];
    let queues = [vk::DeviceQueueCreateInfo::default()
        .queue_family_index(family)
        .queue_priorities(&priorities)];
    let extensions: Vec<_> = extensions.iter().map(|name| name.as_ptr()).collect();
    let (mut vulkan12, mut vulkan13) = required_device_features();
    let info = vk::DeviceCreateInfo::default()
        .queue_create_infos(&queues)
        .enabled_extension_names(&extensions)
        .push_next(&mut vulkan12)
        .push_next(&mut vulkan13);
    // SAFETY: `info` points at live locals.
    unsafe { instance.create_device(physical, &info, None) }.unwrap()
}

fn messenger_info(messages: &Mutex<Vec<String>>) -> vk::DebugUtilsMessengerCreateInfoEXT<'static> {
    let severity = vk::DebugUtilsMessageSeverityFlagsEXT::ERROR
        | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING;
    vk::DebugUtilsMessengerCreateInfoEXT::default()
        .message_severity(severity)
        .message_type(vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION)
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
    messages.lock().unwrap().push(message);
    vk::FALSE
}
