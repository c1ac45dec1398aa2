//! Renderers: their making, and what their frames have become.

use nightsplat::gpu::Gpu;
use nightsplat::splats::render::{Drawn, Pick, PickedSplat, Purpose, RenderSettings, Renderer};

use super::device::NspDevice;
use super::error::{NspResult, Object, guard};
use super::model::{Appearance, LoadedModel, NspModel, appearance, check_device};
use super::structs::{Sized0, destroy, give, object, object_mut, write};

/// A renderer: compiled kernels, and memory that grows with the views. Use it from one thread at a time.
#[derive(Debug)]
pub struct NspRenderer(pub(super) Object<Shown>);

#[derive(Debug)]
pub(super) struct Shown {
    pub(super) gpu: Gpu,
    pub(super) renderer: Renderer,
    pub(super) sh_degree: u32,
    /// Of the model that it was made for, as below.
    gaussian_count: usize,
    pub(super) appearance: Appearance,
}

/// The outcome of the newest frame that is done.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspStatus {
    /// `sizeof(NspStatus)`.
    pub struct_size: usize,
    /// The number of the frame; 0: none is done yet.
    pub frame: u64,
    /// Intersections of splats and tiles, in the view that has the most.
    pub intersections: u32,
    /// The intersections that memory and budget allowed.
    pub capacity: u32,
    /// The intersections that were left out, the farthest.
    pub left_out: u32,
    /// The splats of the fullest tile if the device cannot process that many, and the tile is not drawn; else 0.
    pub splats_per_tile: u32,
    /// Bytes of device memory in use by all objects of the device.
    pub device_bytes: u64,
}

// SAFETY: the size comes first; the rest are numbers.
unsafe impl Sized0 for NspStatus {
    const NAME: &'static str = "NspStatus";
    const FIRST_SIZE: usize = size_of::<Self>();
}

/// What the newest pick that is done found.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspPick {
    /// `sizeof(NspPick)`.
    pub struct_size: usize,
    /// The number of its frame; 0: none is done yet.
    pub frame: u64,
    /// 1: a splat blocks half of the light, with those before it; 0: none does, and the rest is 0.
    pub is_hit: u32,
    /// The index in `NspRender::instances`; 0 where a model is drawn.
    pub instance: u32,
    /// The index of the splat's Gaussian in its model.
    pub gaussian: u32,
    /// Its depth in the view, world units.
    pub depth: f32,
}

// SAFETY: the size comes first; the rest are numbers.
unsafe impl Sized0 for NspPick {
    const NAME: &'static str = "NspPick";
    const FIRST_SIZE: usize = size_of::<Self>();
}

/// Creates a renderer for models with the SH degree, near plane, colours and tone law of `model`.
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
                let LoadedModel { model, on_device } =
                    object(model, "model")?.0.get("the model")?;
                check_device(gpu, on_device)?;
                let settings = RenderSettings { purpose: Purpose::Show, ..model.render_settings() };
                let renderer = Renderer::new(gpu, settings)?;
                Ok(NspRenderer(Object::new(Shown {
                    gpu: gpu.clone(),
                    renderer,
                    sh_degree: model.gaussians.shape.sh_degree,
                    gaussian_count: model.gaussians.count,
                    appearance: appearance(model),
                })))
            })
        }
    })
}

/// Allocates memory for views of this size and for this many intersections, ahead of the first recording.
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
        renderer.0.with("the renderer", |shown| {
            shown.renderer.reserve_draw(shown.gaussian_count, [width, height], intersections)?;
            Ok(())
        })
    })
}

/// Writes the outcome of the newest frame that is done to `status`. It never waits.
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
        let of = |member: fn(&Drawn) -> u32| drawn.as_ref().map_or(0, member);
        let filled = NspStatus {
            struct_size: size_of::<NspStatus>(),
            frame: drawn.map_or(0, |drawn| drawn.frame),
            intersections: of(|drawn| drawn.intersections),
            capacity: of(|drawn| drawn.capacity),
            left_out: of(|drawn| drawn.left_out()),
            splats_per_tile: of(|drawn| drawn.splats_per_tile),
            device_bytes: gpu.memory_in_use(),
        };
        // SAFETY: as the caller promises.
        unsafe { write(status, &filled) }
    })
}

/// Writes what the newest pick that is done found to `pick`. It never waits.
///
/// # Safety
/// `renderer` and `pick` are NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_renderer_picked(
    renderer: *const NspRenderer,
    pick: *mut NspPick,
) -> NspResult {
    guard("nsp_renderer_picked", || {
        // SAFETY: as the caller promises.
        let shown = unsafe { object(renderer, "renderer")? }.0.get("the renderer")?;
        let Pick { frame, hit } = shown.renderer.picked().unwrap_or(Pick { frame: 0, hit: None });
        let none = PickedSplat { instance: 0, gaussian: 0, depth: 0.0 };
        let PickedSplat { instance, gaussian, depth } = hit.unwrap_or(none);
        let filled = NspPick {
            struct_size: size_of::<NspPick>(),
            frame,
            is_hit: hit.is_some().into(),
            instance: instance as u32,
            gaussian,
            depth,
        };
        // SAFETY: as the caller promises.
        unsafe { write(pick, &filled) }
    })
}

/// Destroys a renderer; frames that use it may be in flight.
///
/// # Safety
/// `renderer` is NULL or valid, and not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_renderer_destroy(renderer: *mut NspRenderer) {
    // SAFETY: as the caller promises.
    unsafe { destroy("nsp_renderer_destroy", renderer) }
}
