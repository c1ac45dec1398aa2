//! Renders recorded into a host's command buffers and images.

use ash::vk;
use ash::vk::Handle as _;

use super::camera::NspCamera;
use super::device::NspDevice;
use super::error::{Failure, NspResult, Object, guard};
use super::model::{Loaded, NspModel};
use super::structs::{Sized0, destroy, give, object, object_mut, read, write};
use crate::camera::Camera;
use crate::gpu::{Gpu, HostFrame, HostImage, ImageFormat, ImageState};
use crate::splats::render::{
    DepthConvention, DepthKind, Purpose, RenderOptions, RenderSettings, Renderer, SceneDepth,
    Target,
};

/// Vulkan's.
pub type VkImage = vk::Image;
/// Vulkan's.
pub type VkFormat = vk::Format;
/// Vulkan's.
pub type VkExtent2D = vk::Extent2D;
/// Vulkan's.
pub type VkImageLayout = vk::ImageLayout;
/// Vulkan's.
pub type VkPipelineStageFlags2 = vk::PipelineStageFlags2;
/// Vulkan's.
pub type VkAccessFlags2 = vk::AccessFlags2;
/// Vulkan's.
pub type VkCommandBuffer = vk::CommandBuffer;

/// A renderer: kernels, and memory that grows with the views. One thread uses it at a time.
#[derive(Debug)]
pub struct NspRenderer(Object<Shown>);

#[derive(Debug)]
struct Shown {
    gpu: Gpu,
    renderer: Renderer,
    sh_degree: u32,
    /// Of the model that it was made for.
    gaussian_count: usize,
}

/// The state of an image before or after a recording.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspImageState {
    /// Its layout.
    pub layout: VkImageLayout,
    /// The queue family that owns it; `VK_QUEUE_FAMILY_IGNORED`: ownership is not transferred.
    pub family: u32,
    /// Of the host's commands that use it.
    pub stages: VkPipelineStageFlags2,
    /// Of these commands.
    pub access: VkAccessFlags2,
}

/// A layer of an image: mip level 0, one sample; usage `TRANSFER_DST` to be written, `TRANSFER_SRC` to be read.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspImage {
    /// The image.
    pub image: VkImage,
    /// Its format.
    pub format: VkFormat,
    /// At least the camera's.
    pub extent: VkExtent2D,
    /// The array layer of the first camera.
    pub layer: u32,
    /// As the host leaves it.
    pub before: NspImageState,
    /// As it is afterwards. Where the families differ, our half of the transfer is recorded.
    pub after: NspImageState,
}

/// Blended over what `color` holds, instead of replacing it.
pub const NSP_RENDER_OVER: u32 = 1;
/// A float image gets display-referred values, as they were trained.
pub const NSP_RENDER_DISPLAY_FLOAT: u32 = 2;
/// `scene_depth` is 1 at the near plane.
pub const NSP_DEPTH_REVERSED: u32 = 4;
/// `scene_depth` is the depth in the view, world units.
pub const NSP_DEPTH_LINEAR: u32 = 8;
/// `depth_out` is the mean of what is seen; otherwise the depth at which half of it is.
pub const NSP_DEPTH_EXPECTED: u32 = 16;

/// Colours are those of the dark photographs, by the law that the model states: their linear light where the image is
/// linear, else their values. `background` stays.
pub const NSP_RENDER_PHOTOGRAPH: u32 = 32;

const FLAGS: u32 = NSP_RENDER_OVER
    | NSP_RENDER_DISPLAY_FLOAT
    | NSP_RENDER_PHOTOGRAPH
    | NSP_DEPTH_REVERSED
    | NSP_DEPTH_LINEAR
    | NSP_DEPTH_EXPECTED;

/// One render.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspRender {
    /// `sizeof(NspRender)`.
    pub struct_size: usize,
    /// Primary, recording, outside a render pass, of the lent family. It is submitted once, in the order of recording.
    pub commands: VkCommandBuffer,
    /// The number that the host's timeline reaches after it; it never falls.
    pub frame: u64,
    /// Camera i is drawn into layer `layer + i` of each image.
    pub cameras: *const NspCamera,
    /// Their number.
    pub camera_count: u32,
    /// `NSP_RENDER_*` and `NSP_DEPTH_*`.
    pub flags: u32,
    /// RGBA16F (linear), RGBA8 or BGRA8 as UNORM or SRGB, premultiplied; NULL: none.
    pub color: *const NspImage,
    /// R32F: depth in the view, infinite where nothing is seen; NULL: none.
    pub depth_out: *const NspImage,
    /// D32, D24 or D16 with or without stencil, or R32F: the depth beyond which nothing is drawn; NULL: none.
    pub scene_depth: *const NspImage,
    /// The near plane of `scene_depth`, world units.
    pub scene_near: f32,
    /// The far plane; 0: infinite.
    pub scene_far: f32,
    /// The factor on linear light; 0 is 1.
    pub exposure: f32,
    /// Display-referred; shows where alpha is below 1, unless over.
    pub background: [f32; 3],
    /// The most intersections of a view, the nearest first; 0: as memory allows.
    pub budget: u32,
    /// Unused.
    pub reserved: u32,
}

// SAFETY: the size comes first; null handles and pointers are zeros.
unsafe impl Sized0 for NspRender {
    const NAME: &'static str = "NspRender";
    const FIRST_SIZE: usize = size_of::<Self>();
}

/// How the newest frame that is done went.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspStatus {
    /// `sizeof(NspStatus)`.
    pub struct_size: usize,
    /// Its number; 0: none is done yet.
    pub frame: u64,
    /// Intersections of splats and tiles in its view with the most.
    pub intersections: u32,
    /// Those that memory and budget allowed.
    pub capacity: u32,
    /// Those that were left out, the farthest.
    pub left_out: u32,
    /// Splats of one tile, where the device cannot follow them all and the tile is empty; else 0.
    pub splats_per_tile: u32,
    /// Device memory in use by everything made with the device.
    pub device_bytes: u64,
}

// SAFETY: the size comes first; the rest are numbers.
unsafe impl Sized0 for NspStatus {
    const NAME: &'static str = "NspStatus";
    const FIRST_SIZE: usize = size_of::<Self>();
}

/// Makes a renderer for models with the SH degree, near plane, colours and law of `model`.
///
/// # Safety
/// `device` and `model` are NULL or valid; `renderer` is NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_renderer_create(
    device: *mut NspDevice,
    model: *const NspModel,
    renderer: *mut *mut NspRenderer,
) -> NspResult {
    guard("nsp_renderer_create", || {
        // SAFETY: as the caller promises.
        unsafe {
            give(renderer, "renderer", || {
                let gpu = object(device, "device")?.0.get("the device")?;
                let Loaded { model, on_device } = object(model, "model")?.0.get("the model")?;
                check_device(gpu, on_device)?;
                let settings = RenderSettings { purpose: Purpose::Show, ..model.render_settings() };
                let renderer = Renderer::new(gpu, settings)?;
                Ok(NspRenderer(Object::new(Shown {
                    gpu: gpu.clone(),
                    renderer,
                    sh_degree: model.gaussians.shape.sh_degree,
                    gaussian_count: model.gaussians.count,
                })))
            })
        }
    })
}

fn check_device(
    gpu: &Gpu,
    on_device: &crate::splats::scene::DeviceGaussians,
) -> Result<(), Failure> {
    match on_device.parameters.is_on(gpu) {
        true => Ok(()),
        false => Err(Failure::usage("the model is on another device; load it with this one")),
    }
}

/// Takes memory for views of this size, and for this many intersections, ahead of the first recording.
///
/// # Safety
/// `renderer` is NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_renderer_reserve(
    renderer: *mut NspRenderer,
    width: u32,
    height: u32,
    intersections: u32,
) -> NspResult {
    guard("nsp_renderer_reserve", || {
        // SAFETY: as the caller promises.
        let renderer = unsafe { object_mut(renderer, "renderer")? };
        renderer.0.with("the renderer", |own| {
            own.renderer.reserve_draw(own.gaussian_count, [width, height], intersections)?;
            Ok(())
        })
    })
}

/// Records the render of a model. It submits nothing and waits for nothing; where memory is too small for the view,
/// the nearest splats are drawn, and a later call grows it.
///
/// It binds compute pipelines, descriptors of set 0 and push constants, and restores none of them.
///
/// # Safety
/// `renderer` and `model` are NULL or valid; `render` says the truth.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_record_render(
    renderer: *mut NspRenderer,
    model: *const NspModel,
    render: *const NspRender,
) -> NspResult {
    guard("nsp_record_render", || {
        // SAFETY: as the caller promises.
        let (renderer, model, render) =
            unsafe { (object_mut(renderer, "renderer")?, object(model, "model")?, read(render)?) };
        let loaded = model.0.get("the model")?;
        // SAFETY: as the caller promises.
        renderer.0.with("the renderer", |own| unsafe { record(own, loaded, &render) })
    })
}

/// # Safety
/// `render` says the truth.
unsafe fn record(own: &mut Shown, loaded: &Loaded, render: &NspRender) -> Result<(), Failure> {
    check_device(&own.gpu, &loaded.on_device)?;
    if render.commands == vk::CommandBuffer::null() {
        return Err(Failure::usage("NspRender::commands is NULL"));
    }
    if render.flags & !FLAGS != 0 {
        let flags = render.flags & !FLAGS;
        return Err(Failure::usage(format!("NspRender::flags has the unknown bits {flags:#x}")));
    }
    if render.camera_count == 0 || render.cameras.is_null() {
        return Err(Failure::usage("NspRender::cameras is NULL or empty"));
    }
    // SAFETY: as the caller promises.
    let (cameras, color, depth, scene) = unsafe {
        let cameras = std::slice::from_raw_parts(render.cameras, render.camera_count as usize);
        let image = |image: *const NspImage, name| image.as_ref().map(|own| lent(own, name));
        (
            cameras.iter().map(Camera::from).collect::<Vec<_>>(),
            image(render.color, "NspRender::color").transpose()?,
            image(render.depth_out, "NspRender::depth_out").transpose()?,
            image(render.scene_depth, "NspRender::scene_depth").transpose()?,
        )
    };
    let has = |flag: u32| render.flags & flag != 0;
    let far = Some(render.scene_far).filter(|&far| far != 0.0);
    let near = render.scene_near;
    let convention = match (has(NSP_DEPTH_LINEAR), has(NSP_DEPTH_REVERSED)) {
        (true, _) => DepthConvention::Linear,
        (false, true) => DepthConvention::Reversed { near, far },
        (false, false) => DepthConvention::Forward { near, far },
    };
    let target = Target {
        color: color.as_ref(),
        depth: depth.as_ref(),
        depth_kind: if has(NSP_DEPTH_EXPECTED) { DepthKind::Expected } else { DepthKind::Median },
        scene: scene.as_ref().map(|image| SceneDepth { image, convention }),
        is_over: has(NSP_RENDER_OVER),
        is_display_referred: has(NSP_RENDER_DISPLAY_FLOAT),
        is_photograph: has(NSP_RENDER_PHOTOGRAPH),
        exposure: if render.exposure == 0.0 { 1.0 } else { render.exposure },
        budget: render.budget,
    };
    let options = RenderOptions { sh_degree: own.sh_degree, background: render.background };
    let frame = HostFrame { commands: render.commands.as_raw(), number: render.frame, readers: 0 };
    let Shown { gpu, renderer, .. } = own;
    // What can fail does so before anything is recorded.
    renderer.prepare_draw(&loaded.on_device.layout, &cameras, &target)?;
    // SAFETY: as the caller promises.
    unsafe {
        gpu.record_into(&frame, |pass| {
            renderer.draw(pass, &loaded.on_device, &cameras, &options, &target)
        })
    }?;
    Ok(())
}

fn lent(image: &NspImage, name: &str) -> Result<HostImage, Failure> {
    let format = ImageFormat::from_vulkan(image.format.as_raw()).ok_or_else(|| {
        Failure::usage(format!(
            "{name} has format {:?}; take RGBA16F, RGBA8 or BGRA8 (UNORM, SRGB) for color, R32F for depth_out, \
             D32, D24, D16 or R32F for scene_depth",
            image.format
        ))
    })?;
    let state = |own: NspImageState| ImageState {
        layout: own.layout.as_raw(),
        family: own.family,
        stages: own.stages.as_raw(),
        access: own.access.as_raw(),
    };
    Ok(HostImage {
        handle: image.image.as_raw(),
        format,
        size: [image.extent.width, image.extent.height],
        layer: image.layer,
        before: state(image.before),
        after: state(image.after),
    })
}

/// Fills `status` with how the newest frame that is done went. It never waits.
///
/// # Safety
/// `renderer` and `status` are NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_renderer_status(
    renderer: *const NspRenderer,
    status: *mut NspStatus,
) -> NspResult {
    guard("nsp_renderer_status", || {
        // SAFETY: as the caller promises.
        let Shown { gpu, renderer, .. } =
            unsafe { object(renderer, "renderer")? }.0.get("the renderer")?;
        let drawn = renderer.drawn();
        let of =
            |member: fn(&crate::splats::render::Drawn) -> u32| drawn.as_ref().map_or(0, member);
        let own = NspStatus {
            struct_size: size_of::<NspStatus>(),
            frame: drawn.map_or(0, |drawn| drawn.frame),
            intersections: of(|drawn| drawn.intersections),
            capacity: of(|drawn| drawn.capacity),
            left_out: of(|drawn| drawn.left_out()),
            splats_per_tile: of(|drawn| drawn.splats_per_tile),
            device_bytes: gpu.memory_in_use(),
        };
        // SAFETY: as the caller promises.
        unsafe { write(status, &own) }
    })
}

/// Destroys a renderer; its frames may be in flight.
///
/// # Safety
/// `renderer` is NULL or valid, and not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_renderer_destroy(renderer: *mut NspRenderer) {
    // SAFETY: as the caller promises.
    unsafe { destroy("nsp_renderer_destroy", renderer) }
}
