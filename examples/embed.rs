//! A host application with its own Vulkan device:
//! `cargo run --release --no-default-features --features glslang --example embed -- MODEL.ply OUT.ppm`.
//!
//! The host lends its device, lets the renderer record a frame into its command buffer, and submits that itself. The
//! library submits nothing and waits for nothing. `examples/c/embed.c` is the same host in C.

#![expect(unsafe_code, reason = "plays a host application, which calls Vulkan itself")]

use std::error::Error;
use std::ffi::c_void;
use std::fs;

use nightsplat::ash::vk::Handle as _;
use nightsplat::ash::{self, khr, vk};
use nightsplat::glam::{DAffine3, DVec3, Vec3};
use nightsplat::{
    Camera, FeatureStructs, Gaussians, Gpu, HostDevice, HostFrame, HostImage, ImageFormat,
    ImageState, Purpose, RenderOptions, RenderSettings, Renderer, Target, Upload, require_features,
};

const SIZE: [u32; 2] = [320, 240];

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args_os().skip(1);
    let (Some(model), Some(out)) = (arguments.next(), arguments.next()) else {
        return Err("usage: embed MODEL.ply OUT.ppm".into());
    };
    let host = Host::new()?;
    let pixels = {
        // SAFETY: the handles are the host's own and outlive `gpu`.
        let gpu = unsafe { Gpu::from_host(host.lend()) }?;
        draw(&host, &gpu, &Gaussians::open(&model)?)?
        // The library's objects are dropped before the device.
    };
    host.destroy();
    let [width, height] = SIZE;
    let mut file = format!("P6\n{width} {height}\n255\n").into_bytes();
    file.extend(pixels.chunks(4).flat_map(|pixel| &pixel[..3]));
    Ok(fs::write(out, file)?)
}

/// One frame; returns its bytes, RGBA.
fn draw(host: &Host, gpu: &Gpu, gaussians: &Gaussians) -> Result<Vec<u8>, Box<dyn Error>> {
    // Uploads wait for the first frame.
    let on_device = gaussians.upload(gpu)?;
    let settings = RenderSettings {
        shape: gaussians.shape,
        purpose: Purpose::Show,
        ..RenderSettings::default()
    };
    let mut renderer = Renderer::new(gpu, settings)?;
    let options = RenderOptions { sh_degree: gaussians.shape.sh_degree, background: [0.0; 3] };
    let camera = camera_around(gaussians);
    host.frame(1, |commands, image| {
        let color = HostImage {
            handle: image.as_raw(),
            format: ImageFormat::Rgba8Unorm,
            size: SIZE,
            layer: 0,
            before: ImageState::UNDEFINED,
            after: ImageState::TRANSFER_SOURCE,
        };
        let target = Target { color: Some(&color), ..Target::default() };
        let frame = HostFrame { commands: commands.as_raw(), number: 1, readers: 0 };
        // SAFETY: the command buffer is recording, outside a render pass.
        unsafe {
            gpu.record_into(&frame, |pass| {
                renderer.draw(pass, &on_device, &[camera], &options, &target)
            })
        }
        // The host continues here with its own passes, in the same command buffer.
    })
}

/// A camera that looks along z at the middle of the Gaussians, from twice their extent.
fn camera_around(gaussians: &Gaussians) -> Camera {
    let positions = gaussians.means();
    let sum: Vec3 = positions.iter().sum();
    let center = sum / positions.len().max(1) as f32;
    let extent = positions.iter().map(|p| p.distance(center)).fold(0.1, f32::max);
    let eye = DVec3::from(center) - DVec3::Z * f64::from(2.0 * extent);
    Camera::perspective(DAffine3::from_translation(-eye), 0.87, SIZE)
}

// ---------------------------------------------------------------------------
// The host application

struct Host {
    entry: ash::Entry,
    instance: ash::Instance,
    physical: vk::PhysicalDevice,
    family: u32,
    device: ash::Device,
    queue: vk::Queue,
    pool: vk::CommandPool,
    /// Signalled with the number of each frame.
    frames: vk::Semaphore,
}

impl Host {
    /// The first device, with the features that the library requires in addition to the host's own.
    fn new() -> Result<Self, Box<dyn Error>> {
        // SAFETY: every create info points at live locals; the entry is kept as long as the instance.
        unsafe {
            let entry = ash::Entry::load()?;
            let app = vk::ApplicationInfo::default().api_version(vk::API_VERSION_1_3);
            let info = vk::InstanceCreateInfo::default().application_info(&app);
            let instance = entry.create_instance(&info, None)?;
            let physical =
                *instance.enumerate_physical_devices()?.first().ok_or("no Vulkan device")?;
            let families = instance.get_physical_device_queue_family_properties(physical);
            let has_compute =
                |f: &vk::QueueFamilyProperties| f.queue_flags.contains(vk::QueueFlags::COMPUTE);
            let family = families.iter().position(has_compute).ok_or("no compute queue")? as u32;
            let queues = [vk::DeviceQueueCreateInfo::default()
                .queue_family_index(family)
                .queue_priorities(&[1.0])];
            let extensions = [khr::push_descriptor::NAME.as_ptr()];
            let mut info = vk::DeviceCreateInfo::default()
                .queue_create_infos(&queues)
                .enabled_extension_names(&extensions);
            let mut structs = FeatureStructs::default();
            require_features((&raw mut info).cast(), &mut structs, &[]);
            let device = instance.create_device(physical, &info, None)?;
            let queue = device.get_device_queue(family, 0);
            let pool = vk::CommandPoolCreateInfo::default().queue_family_index(family);
            let pool = device.create_command_pool(&pool, None)?;
            let mut kind =
                vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
            let frames = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
            let frames = device.create_semaphore(&frames, None)?;
            Ok(Self { entry, instance, physical, family, device, queue, pool, frames })
        }
    }

    /// The library records and never submits, so it needs no queue.
    fn lend(&self) -> HostDevice<'static> {
        HostDevice {
            get_instance_proc_addr: self.entry.static_fn().get_instance_proc_addr as *const c_void,
            instance: self.instance.handle().as_raw(),
            physical_device: self.physical.as_raw(),
            device: self.device.handle().as_raw(),
            queue_family: self.family,
            is_record_only: true,
            extensions: &[khr::push_descriptor::NAME],
            frames: self.frames.as_raw(),
            ..HostDevice::default()
        }
    }

    /// Records a frame into an image of its own, submits it, waits, and returns the bytes of the image.
    fn frame(
        &self,
        number: u64,
        record: impl FnOnce(vk::CommandBuffer, vk::Image) -> nightsplat::Result<()>,
    ) -> Result<Vec<u8>, Box<dyn Error>> {
        let device = &self.device;
        let [width, height] = SIZE;
        let usage = vk::ImageUsageFlags::TRANSFER_SRC | vk::ImageUsageFlags::TRANSFER_DST;
        let extent = vk::Extent3D { width, height, depth: 1 };
        let image = vk::ImageCreateInfo::default()
            .image_type(vk::ImageType::TYPE_2D)
            .format(vk::Format::R8G8B8A8_UNORM)
            .extent(extent)
            .mip_levels(1)
            .array_layers(1)
            .samples(vk::SampleCountFlags::TYPE_1)
            .usage(usage);
        let bytes = 4 * u64::from(width) * u64::from(height);
        let buffer =
            vk::BufferCreateInfo::default().size(bytes).usage(vk::BufferUsageFlags::TRANSFER_DST);
        let allocate = vk::CommandBufferAllocateInfo::default()
            .command_pool(self.pool)
            .command_buffer_count(1);
        let region = [vk::BufferImageCopy::default().image_extent(extent).image_subresource(
            vk::ImageSubresourceLayers::default()
                .aspect_mask(vk::ImageAspectFlags::COLOR)
                .layer_count(1),
        )];
        // SAFETY: all objects are live and used only by this thread, until the frame is done.
        unsafe {
            let image = device.create_image(&image, None)?;
            let image_memory =
                self.allocate(device.get_image_memory_requirements(image), Default::default())?;
            device.bind_image_memory(image, image_memory, 0)?;
            let buffer = device.create_buffer(&buffer, None)?;
            let mapped =
                vk::MemoryPropertyFlags::HOST_VISIBLE | vk::MemoryPropertyFlags::HOST_COHERENT;
            let memory = self.allocate(device.get_buffer_memory_requirements(buffer), mapped)?;
            device.bind_buffer_memory(buffer, memory, 0)?;

            let commands = device.allocate_command_buffers(&allocate)?;
            device.begin_command_buffer(commands[0], &vk::CommandBufferBeginInfo::default())?;
            record(commands[0], image)?;
            let layout = vk::ImageLayout::TRANSFER_SRC_OPTIMAL;
            device.cmd_copy_image_to_buffer(commands[0], image, layout, buffer, &region);
            device.end_command_buffer(commands[0])?;

            let (signal, values) = ([self.frames], [number]);
            let mut timeline =
                vk::TimelineSemaphoreSubmitInfo::default().signal_semaphore_values(&values);
            let submit = [vk::SubmitInfo::default()
                .command_buffers(&commands)
                .signal_semaphores(&signal)
                .push_next(&mut timeline)];
            device.queue_submit(self.queue, &submit, vk::Fence::null())?;
            let wait = vk::SemaphoreWaitInfo::default().semaphores(&signal).values(&values);
            device.wait_semaphores(&wait, u64::MAX)?;

            let address = device.map_memory(memory, 0, bytes, Default::default())?;
            let pixels = std::slice::from_raw_parts(address.cast::<u8>(), bytes as usize).to_vec();
            device.free_command_buffers(self.pool, &commands);
            device.destroy_buffer(buffer, None);
            device.destroy_image(image, None);
            device.free_memory(memory, None);
            device.free_memory(image_memory, None);
            Ok(pixels)
        }
    }

    fn allocate(
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
            Ok(self.device.allocate_memory(&info, None)?)
        }
    }

    fn destroy(self) {
        // SAFETY: nothing is in flight, and no object of the device is left.
        unsafe {
            self.device.destroy_semaphore(self.frames, None);
            self.device.destroy_command_pool(self.pool, None);
            self.device.destroy_device(None);
            self.instance.destroy_instance(None);
        }
    }
}
