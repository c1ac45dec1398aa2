//! What any wgpu application has: device, textures, a pass of its own. Its lines that are there for the library are
//! `enable`, `open`, `lend`, `images`, and the second encoder of a frame.

use std::error::Error;
use std::ffi::{CStr, c_void};

use nightsplat::ash::vk::{self, Handle as _, TaggedStructure as _};
use nightsplat::ash::{self, khr};
use nightsplat::{
    FeatureStructs, HostDevice, HostFrame, HostImage, ImageFormat, ImageState, require_features,
};
use wgpu_hal::vulkan::{Api as Vulkan, CreateDeviceCallbackArgs};

/// Width and height of the picture.
pub const SIZE: [u32; 2] = [320, 240];
/// The near plane of the host's depth.
pub const NEAR: f32 = 0.1;

const SHADER: &str = "
@vertex fn corner(@builtin(vertex_index) i: u32) -> @builtin(position) vec4f {
    let at = array(vec2f(-1, -1), vec2f(0, -1), vec2f(-1, 1), vec2f(-1, 1), vec2f(0, -1), vec2f(0, 1));
    return vec4f(at[i], DEPTH, 1);
}
@fragment fn color() -> @location(0) vec4f { return vec4f(0.2, 0.6, 0.2, 1); }";

/// Textures on a device of wgpu.
pub struct Host {
    device: wgpu::Device,
    queue: wgpu::Queue,
    color: wgpu::Texture,
    depth: wgpu::Texture,
    read: wgpu::Buffer,
    /// Reaches the number of each frame.
    frames: vk::Semaphore,
}

/// With it wgpu chains the struct of subgroup size control, as it chains that of timeline semaphores anyway.
pub const FEATURES: wgpu::Features = wgpu::Features::SUBGROUP;

/// Enables what the library needs on a device that wgpu is about to open with [`FEATURES`].
///
/// # Safety
/// The structs outlive the call that creates the device.
pub unsafe fn enable(arguments: &mut CreateDeviceCallbackArgs, structs: &mut FeatureStructs) {
    let chained_by_wgpu = [
        vk::PhysicalDeviceTimelineSemaphoreFeatures::STRUCTURE_TYPE.as_raw(),
        vk::PhysicalDeviceSubgroupSizeControlFeatures::STRUCTURE_TYPE.as_raw(),
    ];
    arguments.extensions.push(khr::push_descriptor::NAME);
    let chain: *mut vk::DeviceCreateInfo<'_> = arguments.create_info;
    // SAFETY: the chain is valid, and the structs live as long as it does.
    unsafe { require_features(chain.cast(), structs, &chained_by_wgpu) };
}

/// Opens a device as wgpu does, and enables what the library needs in wgpu's callback.
fn open(adapter: &wgpu::Adapter) -> Result<(wgpu::Device, wgpu::Queue), Box<dyn Error>> {
    let limits = wgpu::Limits::default();
    let mut structs = FeatureStructs::default();
    // SAFETY: the structs outlive the call that creates the device.
    let opened = unsafe {
        let hal = adapter.as_hal::<Vulkan>().ok_or("wgpu has no Vulkan here")?;
        let callback = |mut arguments: CreateDeviceCallbackArgs<'_, '_, '_>| {
            enable(&mut arguments, &mut structs)
        };
        let hints = wgpu::MemoryHints::default();
        hal.open_with_callback(FEATURES, &limits, &hints, Some(Box::new(callback)))?
    };
    let descriptor = wgpu::DeviceDescriptor {
        required_features: FEATURES,
        required_limits: limits,
        ..Default::default()
    };
    // SAFETY: opened from this adapter, with these features.
    Ok(unsafe { adapter.create_device_from_hal(opened, &descriptor) }?)
}

impl Host {
    /// On the first Vulkan device, opened as wgpu opens it.
    pub fn new() -> Result<Self, Box<dyn Error>> {
        let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
        descriptor.backends = wgpu::Backends::VULKAN;
        let instance = wgpu::Instance::new(descriptor);
        let adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::VULKAN));
        let adapter = adapters.into_iter().next().ok_or("no Vulkan device")?;
        let (device, queue) = open(&adapter)?;
        Self::on(device, queue)
    }

    /// On a device for which [`enable`] was called.
    pub fn on(device: wgpu::Device, queue: wgpu::Queue) -> Result<Self, Box<dyn Error>> {
        let size = wgpu::Extent3d { width: SIZE[0], height: SIZE[1], depth_or_array_layers: 1 };
        let texture = |format, copied| {
            device.create_texture(&wgpu::TextureDescriptor {
                label: None,
                size,
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format,
                usage: wgpu::TextureUsages::RENDER_ATTACHMENT
                    | wgpu::TextureUsages::COPY_SRC
                    | copied,
                view_formats: &[],
            })
        };
        let none = wgpu::TextureUsages::empty();
        let color = texture(wgpu::TextureFormat::Rgba8Unorm, wgpu::TextureUsages::COPY_DST);
        let depth = texture(wgpu::TextureFormat::Depth32Float, none);
        let read = device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: 4 * u64::from(SIZE[0] * SIZE[1]),
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        });
        let mut kind =
            vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
        let info = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
        // SAFETY: the device is live.
        let frames = unsafe { raw_device(&device)?.create_semaphore(&info, None) }?;
        Ok(Self { device, queue, color, depth, read, frames })
    }

    /// The device as the library takes it. It records and never submits, so it needs no queue.
    pub fn lend(&self) -> HostDevice<'static> {
        const EXTENSIONS: &[&CStr] = &[khr::push_descriptor::NAME];
        // SAFETY: the handles are only copied.
        let hal = unsafe { self.device.as_hal::<Vulkan>() };
        let Some(hal) = hal else { return HostDevice::default() };
        let instance = hal.shared_instance();
        HostDevice {
            get_instance_proc_addr: instance.entry().static_fn().get_instance_proc_addr
                as *const c_void,
            instance: instance.raw_instance().handle().as_raw(),
            physical_device: hal.raw_physical_device().as_raw(),
            device: hal.raw_device().handle().as_raw(),
            queue_family: hal.queue_family_index(),
            is_record_only: true,
            extensions: EXTENSIONS,
            frames: self.frames.as_raw(),
            ..HostDevice::default()
        }
    }

    /// Colour and depth, as a frame lends them: in the states that `transition_resources` puts them in.
    pub fn images(&self) -> (HostImage, HostImage) {
        let image = |texture: &wgpu::Texture, format, state| {
            // SAFETY: the handle is only copied.
            let hal = unsafe { texture.as_hal::<Vulkan>() };
            // SAFETY: as above.
            let handle = hal.map_or(0, |hal| unsafe { hal.raw_handle() }.as_raw());
            HostImage { handle, format, size: SIZE, layer: 0, before: state, after: state }
        };
        let (to, from) = (ImageState::TRANSFER_TARGET, ImageState::TRANSFER_SOURCE);
        (
            image(&self.color, ImageFormat::Rgba8Unorm, to),
            image(&self.depth, ImageFormat::D32Float, from),
        )
    }

    /// Draws the wall, has `record` draw over it, and reads the picture.
    pub fn frame(
        &self,
        number: u64,
        wall: Option<f32>,
        record: impl FnOnce(HostFrame) -> nightsplat::Result<()>,
    ) -> Result<Vec<u8>, Box<dyn Error>> {
        let encoder = || self.device.create_command_encoder(&Default::default());
        let mut first = encoder();
        self.draw_wall(&mut first, wall);
        let to = |texture, state| wgpu::TextureTransition { texture, selector: None, state };
        let states = [
            to(&self.color, wgpu::TextureUses::COPY_DST),
            to(&self.depth, wgpu::TextureUses::COPY_SRC),
        ];
        first.transition_resources(std::iter::empty(), states.into_iter());
        // wgpu takes raw recording in an encoder that has nothing else.
        let mut second = encoder();
        let mut recorded = Err("wgpu has no command buffer".into());
        // SAFETY: the command buffer is recorded by the library alone, and the semaphore is live.
        unsafe {
            second.as_hal_mut::<Vulkan, _, _>(|hal| {
                let Some(hal) = hal else { return };
                let commands = hal.raw_handle().as_raw();
                recorded = record(HostFrame { commands, number, readers: 0 }).map_err(Into::into);
            });
            let queue = self.queue.as_hal::<Vulkan>().ok_or("wgpu has no Vulkan queue")?;
            queue.add_signal_semaphore(self.frames, Some(number));
        }
        recorded.map_err(|error: Box<dyn Error>| error)?;
        let mut third = encoder();
        let layout = wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some(4 * SIZE[0]),
            rows_per_image: None,
        };
        let target = wgpu::TexelCopyBufferInfo { buffer: &self.read, layout };
        third.copy_texture_to_buffer(self.color.as_image_copy(), target, self.color.size());
        self.queue.submit([first.finish(), second.finish(), third.finish()]);
        self.pixels()
    }

    fn pixels(&self) -> Result<Vec<u8>, Box<dyn Error>> {
        let slice = self.read.slice(..);
        slice.map_async(wgpu::MapMode::Read, |_| {});
        self.device.poll(wgpu::PollType::wait_indefinitely())?;
        let pixels = slice.get_mapped_range()?.to_vec();
        self.read.unmap();
        Ok(pixels)
    }

    fn draw_wall(&self, encoder: &mut wgpu::CommandEncoder, wall: Option<f32>) {
        let [color, depth] =
            [&self.color, &self.depth].map(|texture| texture.create_view(&Default::default()));
        let load = wgpu::LoadOp::Clear(wgpu::Color::BLACK);
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &color,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load, store: wgpu::StoreOp::Store },
            })],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &depth,
                depth_ops: Some(wgpu::Operations {
                    load: wgpu::LoadOp::Clear(1.0),
                    store: wgpu::StoreOp::Store,
                }),
                stencil_ops: None,
            }),
            ..Default::default()
        });
        if let Some(wall) = wall {
            pass.set_pipeline(&self.wall(1.0 - NEAR / wall));
            pass.draw(0..6, 0..1);
        }
    }

    /// A pipeline that fills the left half at this depth.
    fn wall(&self, depth: f32) -> wgpu::RenderPipeline {
        let source =
            wgpu::ShaderSource::Wgsl(SHADER.replace("DEPTH", &format!("{depth:.7}")).into());
        let module =
            &self.device.create_shader_module(wgpu::ShaderModuleDescriptor { label: None, source });
        let compilation_options = wgpu::PipelineCompilationOptions::default();
        self.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: None,
            layout: None,
            vertex: wgpu::VertexState {
                module,
                entry_point: Some("corner"),
                compilation_options: compilation_options.clone(),
                buffers: &[],
            },
            fragment: Some(wgpu::FragmentState {
                module,
                entry_point: Some("color"),
                compilation_options,
                targets: &[Some(wgpu::TextureFormat::Rgba8Unorm.into())],
            }),
            primitive: Default::default(),
            depth_stencil: Some(wgpu::DepthStencilState {
                format: wgpu::TextureFormat::Depth32Float,
                depth_write_enabled: Some(true),
                depth_compare: Some(wgpu::CompareFunction::Less),
                stencil: Default::default(),
                bias: Default::default(),
            }),
            multisample: Default::default(),
            multiview_mask: None,
            cache: None,
        })
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        if let Ok(device) = raw_device(&self.device) {
            // SAFETY: every frame was waited for.
            unsafe { device.destroy_semaphore(self.frames, None) };
        }
    }
}

fn raw_device(device: &wgpu::Device) -> Result<ash::Device, Box<dyn Error>> {
    // SAFETY: the functions and the handle are only copied.
    let hal = unsafe { device.as_hal::<Vulkan>() }.ok_or("wgpu has no Vulkan device")?;
    Ok(hal.raw_device().clone())
}
