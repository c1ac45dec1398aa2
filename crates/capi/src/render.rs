//! Renders recorded into a host's command buffers and images.

use ash::vk;
use ash::vk::Handle as _;
use nightsplat::gpu::{HostFrame, ImageFormat};
use nightsplat::splats::render::{
    DepthConvention, DepthKind, Instance, Motion, RenderOptions, SceneDepth, Target,
};
use nightsplat_core::camera::Camera;
use nightsplat_models::gaussians::MAX_SH_DEGREE;

use super::camera::NspCamera;
use super::device::VkCommandBuffer;
use super::error::{Failure, NspResult, guard};
use super::image::{NspImage, lent};
use super::instance::{NspInstance, lent_instance};
use super::model::{LoadedModel, NspModel, check_device};
use super::renderer::{NspRenderer, Shown};
use super::structs::{Sized0, object, object_mut, read, read_all};

/// Blends over the contents of `color` instead of replacing them.
pub const NSP_RENDER_OVER: u32 = 1;
/// Writes display-referred values, as they were trained, to a float `color` image; otherwise linear light.
pub const NSP_RENDER_DISPLAY_FLOAT: u32 = 2;
/// `scene_depth`, and `depth_out` in D32, are reversed: 1 at the near plane, 0 at the far plane.
pub const NSP_DEPTH_REVERSED: u32 = 4;
/// `scene_depth` is linear view-space depth in world units.
pub const NSP_DEPTH_LINEAR: u32 = 8;
/// `depth_out` is the expected depth, the mean of the splats' depths by their blending weights; otherwise the median
/// depth, at which the transmittance falls below 1/2.
pub const NSP_DEPTH_EXPECTED: u32 = 16;

/// Renders the colours of the dark photographs, by inverting the tone law that the model states: linear light in a
/// linear image, encoded values otherwise. `background` is not changed.
pub const NSP_RENDER_PHOTOGRAPH: u32 = 32;

/// `pick` is a pixel of the first camera, of which `nsp_renderer_picked` tells what is there.
pub const NSP_RENDER_PICK: u32 = 64;

/// All cameras have one sort, by the depth along the mean of their axes: pinholes or orthographic, which look at most
/// 30 degrees beside it. Where their axes are parallel, the pictures are the same; else splats that intersect may
/// change their order.
pub const NSP_RENDER_ONE_SORT: u32 = 128;

const FLAGS: u32 = NSP_RENDER_OVER
    | NSP_RENDER_PICK
    | NSP_RENDER_ONE_SORT
    | NSP_RENDER_DISPLAY_FLOAT
    | NSP_RENDER_PHOTOGRAPH
    | NSP_DEPTH_REVERSED
    | NSP_DEPTH_LINEAR
    | NSP_DEPTH_EXPECTED;

/// The parameters of a render.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspRender {
    /// `sizeof(NspRender)`.
    pub struct_size: usize,
    /// A primary command buffer of the lent queue family, in the recording state, outside a render pass. The host
    /// submits it once, in the order of recording.
    pub commands: VkCommandBuffer,
    /// The value that the host's timeline semaphore reaches when the command buffer is done; it never decreases.
    pub frame: u64,
    /// Camera i is drawn into layer `layer + i` of each image.
    pub cameras: *const NspCamera,
    /// The number of cameras.
    pub camera_count: u32,
    /// `NSP_RENDER_*` and `NSP_DEPTH_*`.
    pub flags: u32,
    /// Colour with premultiplied alpha: RGBA16F, RGBA32F or B10G11R11 (linear), RGBA8 or BGRA8 as UNORM or SRGB,
    /// A2B10G10R10 or A2R10G10B10 (UNORM); NULL: none.
    pub color: *const NspImage,
    /// Depth; NULL: none. As R32F: in the view, infinite where there is no splat. As D32, with or without stencil: by
    /// the projection of `scene_near`, `scene_far` and `NSP_DEPTH_REVERSED`, and at the far plane where there is no
    /// splat; it may be the image of `scene_depth`, which keeps its depth there.
    pub depth_out: *const NspImage,
    /// The host's depth buffer, which occludes splats: D32, D24 or D16 with or without stencil, or R32F; NULL: none.
    pub scene_depth: *const NspImage,
    /// The near plane of the host's depth in world units.
    pub scene_near: f32,
    /// The far plane of the host's depth in world units; 0: at infinity.
    pub scene_far: f32,
    /// The factor on linear light; 0 stands for 1.
    pub exposure: f32,
    /// The background colour, display-referred; not used with `NSP_RENDER_OVER`.
    pub background: [f32; 3],
    /// The most intersections of splats and tiles in a view, of which the farthest are left out first; 0: as memory
    /// allows.
    pub budget: u32,
    /// The number of instances.
    pub instance_count: u32,
    /// The models that are drawn, sorted together; NULL: the model that is passed.
    pub instances: *const NspInstance,
    /// `color` of ten bits is HDR10 (BT.2020, ST 2084), and linear light 1 is this many nits; 0: display-referred.
    pub hdr10_nits: f32,
    /// With `NSP_RENDER_PICK`: column and row.
    pub pick: [u32; 2],
    /// Unused.
    pub reserved: u32,
    /// Motion vectors as RG16F or RG32F: from each pixel to where its point was in the frame before, in pixels; NULL:
    /// none. The point is at the depth in the view, infinitely far where there is no splat, and moves with the camera
    /// and with the instance (`NspInstance::pose_before`) of the splat at which half of the light is blocked.
    pub motion_out: *const NspImage,
    /// The cameras of the frame before, as many as `cameras`, of the same sizes and models; read with `motion_out`.
    /// With the principal point of this frame's, a jitter is left out.
    pub cameras_before: *const NspCamera,
}

// SAFETY: the size comes first; null handles and pointers are zeros.
unsafe impl Sized0 for NspRender {
    const NAME: &'static str = "NspRender";
    const FIRST_SIZE: usize = std::mem::offset_of!(Self, hdr10_nits);
}

/// Records the render of a model, or of `NspRender::instances` if `model` is NULL. Nothing is submitted, and nothing is
/// waited for. If the view needs more memory than there is, the nearest splats are drawn, and a later call allocates
/// more.
///
/// It binds compute pipelines, descriptor set 0 and push constants, and restores none of them.
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
        let (renderer, render) = unsafe { (object_mut(renderer, "renderer")?, read(render)?) };
        // SAFETY: as the caller promises.
        renderer.0.with("the renderer", |shown| unsafe { record(shown, model, &render) })
    })
}

/// # Safety
/// `render` says the truth.
unsafe fn record(
    shown: &mut Shown,
    model: *const NspModel,
    render: &NspRender,
) -> Result<(), Failure> {
    // SAFETY: as the caller promises.
    let models = &unsafe { models(shown, model, render) }?;
    if render.commands == vk::CommandBuffer::null() {
        return Err(Failure::usage("NspRender::commands is NULL"));
    }
    if render.flags & !FLAGS != 0 {
        let flags = render.flags & !FLAGS;
        return Err(Failure::usage(format!("NspRender::flags has the unknown bits {flags:#x}")));
    }
    if render.reserved != 0 {
        return Err(Failure::usage("NspRender::reserved is not 0"));
    }
    if render.camera_count == 0 || render.cameras.is_null() {
        return Err(Failure::usage("NspRender::cameras is NULL or empty"));
    }
    // SAFETY: as the caller promises.
    let (color, depth, scene, motion, cameras, before) = unsafe {
        let image = |image: *const NspImage, name| {
            (!image.is_null()).then(|| lent(&read(image)?, name, render.camera_count))
        };
        (
            image(render.color, "NspRender::color").transpose()?,
            image(render.depth_out, "NspRender::depth_out").transpose()?,
            image(render.scene_depth, "NspRender::scene_depth").transpose()?,
            image(render.motion_out, "NspRender::motion_out").transpose()?,
            cameras(render.cameras, render.camera_count)?,
            match render.motion_out.is_null() {
                true => vec![],
                false => cameras(render.cameras_before, render.camera_count)?,
            },
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
        depth_convention: match &depth {
            Some(image) if image.format != ImageFormat::R32Float => convention,
            _ => DepthConvention::Linear,
        },
        scene: scene.as_ref().map(|image| SceneDepth { image, convention }),
        is_over: has(NSP_RENDER_OVER),
        is_display_referred: has(NSP_RENDER_DISPLAY_FLOAT),
        is_photograph: has(NSP_RENDER_PHOTOGRAPH),
        exposure: if render.exposure == 0.0 { 1.0 } else { render.exposure },
        hdr10_nits: Some(render.hdr10_nits).filter(|&nits| nits != 0.0),
        motion: motion.as_ref().map(|image| Motion { image, before: &before }),
        pick: has(NSP_RENDER_PICK).then_some(render.pick),
        budget: render.budget,
        shares_sort: has(NSP_RENDER_ONE_SORT),
    };
    let sh_degree = match models {
        Models::One(_) => shown.sh_degree,
        Models::Instances(_) => MAX_SH_DEGREE,
    };
    let options = RenderOptions { sh_degree, background: render.background };
    let frame = HostFrame { commands: render.commands.as_raw(), number: render.frame, readers: 0 };
    let Shown { gpu, renderer, .. } = shown;
    // What can fail does so before anything is recorded.
    match models {
        Models::One(loaded) => {
            renderer.prepare_draw(&loaded.on_device.layout, &cameras, &target)?;
        }
        Models::Instances(all) => renderer.prepare_instances(all, &cameras, &target)?,
    }
    // SAFETY: as the caller promises.
    unsafe {
        gpu.record_into(&frame, |pass| match models {
            Models::One(loaded) => {
                renderer.draw(pass, &loaded.on_device, &cameras, &options, &target)
            }
            Models::Instances(all) => {
                renderer.draw_instances(pass, all, &cameras, &options, &target)
            }
        })
    }?;
    Ok(())
}

/// What a render draws.
enum Models<'a> {
    One(&'a LoadedModel),
    Instances(Vec<Instance<'a>>),
}

/// # Safety
/// `model` is NULL or valid, and `render` says the truth.
unsafe fn models<'a>(
    shown: &Shown,
    model: *const NspModel,
    render: &NspRender,
) -> Result<Models<'a>, Failure> {
    let NspRender { instances, instance_count, .. } = *render;
    match (model.is_null(), instances.is_null()) {
        (false, true) if instance_count == 0 => {
            // SAFETY: as the caller promises.
            let model = unsafe { object(model, "model") }?;
            let loaded = model.0.get("the model")?;
            check_device(&shown.gpu, &loaded.on_device)?;
            Ok(Models::One(loaded))
        }
        (true, true) => Err(Failure::usage("model is NULL, and there are no NspRender::instances")),
        (true, false) => {
            let all = match instance_count {
                0 => vec![],
                // SAFETY: as the caller promises.
                _ => unsafe { read_all(instances, instance_count) }?,
            };
            // SAFETY: as the caller promises.
            let each = |(at, instance)| unsafe {
                lent_instance(&shown.gpu, shown.appearance, at, instance)
            };
            Ok(Models::Instances(all.iter().enumerate().map(each).collect::<Result<_, _>>()?))
        }
        _ => Err(Failure::usage("both a model and NspRender::instances; pass one of them")),
    }
}

/// # Safety
/// `from` is NULL or holds `count` cameras.
unsafe fn cameras(from: *const NspCamera, count: u32) -> Result<Vec<Camera>, Failure> {
    // SAFETY: as the caller promises.
    let all = unsafe { read_all(from, count) }?;
    let camera = |(at, camera): (usize, &NspCamera)| {
        camera.camera().map_err(|problem| Failure::usage(format!("camera {at} {problem}")))
    };
    all.iter().enumerate().map(camera).collect()
}
