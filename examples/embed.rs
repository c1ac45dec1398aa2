//! A host application with its own Vulkan device: `cargo run --release --example embed -- OUT.png`.
//!
//! The host lends its device, lets the renderer record into its command buffer, and submits that itself. A host in C++
//! would do the same: every handle is passed as a number.

#![expect(unsafe_code, reason = "plays a host application, which calls Vulkan itself")]

use std::error::Error;
use std::f64::consts::TAU;
use std::ffi::c_void;

use nightsplat::ash::vk::Handle as _;
use nightsplat::ash::{self, khr, vk};
use nightsplat::glam::{DAffine3, DVec3, Vec3};
use nightsplat::{
    Camera, Gaussians, Gpu, HostDevice, HostRecording, Image, Initialization, RenderOptions,
    RenderSettings, Renderer, Status, required_device_features,
};

const OPTIONS: RenderOptions = RenderOptions { sh_degree: 0, background: [0.05, 0.05, 0.1] };

fn main() -> Result<(), Box<dyn Error>> {
    let out = std::env::args_os().nth(1).ok_or("usage: embed OUT.png")?;
    let host = Host::new()?;
    {
        // SAFETY: the handles are the host's own and outlive `gpu`; no other thread uses the queue meanwhile.
        let gpu = unsafe { Gpu::from_host(host.lend()) }?;
        render(&host, &gpu)?.save_png8(out)?;
        // The library's objects are dropped before the device.
    }
    host.destroy();
    Ok(())
}

fn render(host: &Host, gpu: &Gpu) -> Result<Image, Box<dyn Error>> {
    let camera = Camera::perspective(DAffine3::IDENTITY, 0.87, [320, 240]);
    let gaussians = ring()?;
    let on_device = gaussians.upload(gpu)?;
    let settings = RenderSettings { shape: gaussians.shape, ..RenderSettings::default() };
    let mut renderer = Renderer::new(gpu, settings)?;
    // Memory is allocated before anything is recorded.
    renderer.reserve(gaussians.count, [&camera])?;
    loop {
        host.submit(|commands| {
            // SAFETY: the command buffer is recording; the buffers live until the host has waited for it.
            unsafe {
                gpu.record_into(commands.as_raw(), |pass| {
                    renderer.clear_status(pass);
                    renderer.forward(pass, &on_device, &camera, &OPTIONS)
                })
            }
            // The host continues here: `renderer.render().handle()` is a buffer that its own shaders can bind.
        })?;
        // If the view had more intersections than the capacity, nothing was rendered.
        let status = Status::from_words(&gpu.read(renderer.status())?);
        if !status.overflowed {
            break;
        }
        renderer.grow(status.intersections)?;
    }
    let Camera { width, height, .. } = camera;
    let mut data = gpu.read(renderer.render())?;
    data.truncate(3 * width as usize * height as usize);
    Ok(Image { width, height, data })
}

/// A ring of Gaussians in all hues, seen from its axis.
fn ring() -> nightsplat::Result<Gaussians> {
    let angles = (0..600).map(|i| TAU * f64::from(i) / 600.0);
    let position =
        |angle: f64| DVec3::new(angle.cos(), angle.sin(), 3.0 + 0.3 * (5.0 * angle).sin());
    let hue =
        |angle: f64| [0.0, 1.0, 2.0].map(|third| 0.5 + 0.5 * (angle + third * TAU / 3.0).cos());
    let positions: Vec<DVec3> = angles.clone().map(position).collect();
    let colors: Vec<Vec3> = angles.map(|angle| DVec3::from(hue(angle)).as_vec3()).collect();
    let mut gaussians =
        Gaussians::from_points(&positions, &colors, 0, &Initialization::default(), 0)?;
    gaussians.raw_opacities_mut().fill(2.0);
    gaussians.log_scales_mut().fill(Vec3::splat(-3.0));
    Ok(gaussians)
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
            let (mut vulkan12, mut vulkan13) = required_device_features();
            let info = vk::DeviceCreateInfo::default()
                .queue_create_infos(&queues)
                .enabled_extension_names(&extensions)
                .push_next(&mut vulkan12)
                .push_next(&mut vulkan13);
            let device = instance.create_device(physical, &info, None)?;
            let queue = device.get_device_queue(family, 0);
            let pool = vk::CommandPoolCreateInfo::default().queue_family_index(family);
            let pool = device.create_command_pool(&pool, None)?;
            Ok(Self { entry, instance, physical, family, device, queue, pool })
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

    /// Records, submits and waits.
    fn submit(
        &self,
        record: impl FnOnce(vk::CommandBuffer) -> nightsplat::Result<HostRecording>,
    ) -> Result<(), Box<dyn Error>> {
        let device = &self.device;
        let allocate = vk::CommandBufferAllocateInfo::default()
            .command_pool(self.pool)
            .command_buffer_count(1);
        // SAFETY: all objects are live and used only by this thread, until the queue is idle.
        unsafe {
            let commands = device.allocate_command_buffers(&allocate)?;
            device.begin_command_buffer(commands[0], &vk::CommandBufferBeginInfo::default())?;
            // The bound objects stay alive until the queue is idle.
            let _held = record(commands[0])?;
            device.end_command_buffer(commands[0])?;
            let submit = [vk::SubmitInfo::default().command_buffers(&commands)];
            device.queue_submit(self.queue, &submit, vk::Fence::null())?;
            device.queue_wait_idle(self.queue)?;
            device.free_command_buffers(self.pool, &commands);
        }
        Ok(())
    }

    fn destroy(self) {
        // SAFETY: nothing is in flight, and no object of the device is left.
        unsafe {
            self.device.destroy_command_pool(self.pool, None);
            self.device.destroy_device(None);
            self.instance.destroy_instance(None);
        }
    }
}
