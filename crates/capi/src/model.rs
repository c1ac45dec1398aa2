//! Gaussians on a device, with what a renderer must know of them.

use std::ffi::c_char;

use nightsplat_models::gaussians::{Gaussians, width};

use super::camera::affine;
use super::device::NspDevice;
use super::error::{Failure, NSP_ERROR_MEMORY, NSP_ERROR_NOT_FINITE, NspResult, Object, guard};
use super::structs::{Sized0, destroy, give, object, text, write};
use nightsplat::gpu::Gpu;
use nightsplat::splats::device::{DeviceGaussians, Upload};
use nightsplat::splats::model::Model;

/// A model on a device. Use it from one thread at a time.
#[derive(Debug)]
pub struct NspModel(pub(super) Object<LoadedModel>);

/// A model and its Gaussians on the device.
#[derive(Debug)]
pub(super) struct LoadedModel {
    /// On the host, to be joined with others.
    pub(super) model: Model,
    pub(super) on_device: DeviceGaussians,
}

impl NspModel {
    pub(super) fn new(gpu: &Gpu, model: Model) -> Result<Self, Failure> {
        let on_device = model.gaussians.upload(gpu)?;
        Ok(Self(Object::new(LoadedModel { model, on_device })))
    }
}

/// Whether colours are raw, the alpha limit, and antialiasing: what models of one render have in common.
pub(super) type Appearance = (bool, f32, bool);

pub(super) fn appearance(model: &Model) -> Appearance {
    (model.raw_colors, model.max_alpha, model.antialiased)
}

pub(super) fn check_device(gpu: &Gpu, on_device: &DeviceGaussians) -> Result<(), Failure> {
    match on_device.parameters.is_on(gpu) {
        true => Ok(()),
        false => Err(Failure::usage("the model is on another device; load it with this one")),
    }
}

/// The properties of a model.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspModelInfo {
    /// `sizeof(NspModelInfo)`.
    pub struct_size: usize,
    /// The number of Gaussians.
    pub count: u32,
    /// The SH degree, 0 to 3.
    pub sh_degree: u32,
    /// The near plane of the training, in world units.
    pub near_plane: f32,
    /// The largest alpha of a splat on a pixel.
    pub max_alpha: f32,
    /// 1 if colours are the raw SH sum, without the usual offset of 0.5.
    pub raw_colors: u32,
    /// The brightness of the model's colours relative to the photographs, in stops of linear light: with
    /// `NSP_RENDER_PHOTOGRAPH` and an exposure of 2^`law_stops`, renders are as bright as the model. NaN: the model
    /// states no tone law.
    pub law_stops: f32,
    /// The position of the model's origin in the world.
    pub origin: [f64; 3],
}

// SAFETY: the size comes first; the rest are numbers.
unsafe impl Sized0 for NspModelInfo {
    const NAME: &'static str = "NspModelInfo";
    const FIRST_SIZE: usize = size_of::<Self>();
}

/// Loads a model: PLY, SPZ, SOG, or a run directory. The upload is part of the next recording. Gaussians that are not
/// finite are left out, which a warning of the log counts.
///
/// # Safety
/// `device` is NULL or valid, `path` is NULL or ends with NUL, `model` is NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_model_load(
    device: *mut NspDevice,
    path: *const c_char,
    model: *mut *mut NspModel,
) -> NspResult {
    guard("nsp_model_load", || {
        // SAFETY: as the caller promises.
        unsafe {
            give(model, "model", || {
                let gpu = object(device, "device")?.0.get("the device")?;
                NspModel::new(gpu, Model::load(text(path, "path")?)?)
            })
        }
    })
}

/// The planes of `nsp_model_create`.
const PLANES: [&str; 6] =
    ["means", "quats", "log scales", "raw opacities", "SH of degree 0", "SH above degree 0"];

/// Creates a model from arrays: means (count, 3); rotations (count, 4) as w, x, y, z; natural logarithms of scales
/// (count, 3); opacities before the sigmoid (count); SH of degree 0 (count, 3); SH above it (count,
/// (degree + 1)^2 - 1, 3), NULL for degree 0.
///
/// # Safety
/// `planes` is NULL or holds six arrays of these lengths.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_model_create(
    device: *mut NspDevice,
    count: u32,
    sh_degree: u32,
    planes: *const *const f32,
    model: *mut *mut NspModel,
) -> NspResult {
    guard("nsp_model_create", || {
        // SAFETY: as the caller promises.
        unsafe {
            give(model, "model", || {
                let gpu = object(device, "device")?.0.get("the device")?;
                NspModel::new(gpu, gathered(gpu, count, sh_degree, planes)?.into())
            })
        }
    })
}

/// # Safety
/// As [`nsp_model_create`].
unsafe fn gathered(
    gpu: &Gpu,
    count: u32,
    sh_degree: u32,
    planes: *const *const f32,
) -> Result<Gaussians, Failure> {
    if sh_degree > 3 {
        return Err(Failure::usage(format!("sh_degree is {sh_degree}; 3 is the most")));
    }
    if planes.is_null() {
        return Err(Failure::usage("planes is NULL"));
    }
    let used = if sh_degree == 0 { PLANES.len() - 1 } else { PLANES.len() };
    // SAFETY: as the caller promises.
    if let Some(at) = (0..used).find(|&at| count > 0 && unsafe { *planes.add(at) }.is_null()) {
        return Err(Failure::usage(format!("plane {at}, {}, is NULL", PLANES[at])));
    }
    let bytes = u64::from(count) * (size_of::<f32>() * width(sh_degree)) as u64;
    let most = gpu.properties().max_buffer_size;
    if bytes > most {
        return Err(Failure::new(
            NSP_ERROR_MEMORY,
            format!(
                "{count} Gaussians take {bytes} bytes, a buffer of the device {most}; pass fewer"
            ),
        ));
    }
    let mut gaussians = Gaussians::try_zeros(count as usize, sh_degree)?;
    let fill = |at: usize, values: &mut [f32]| {
        if values.is_empty() {
            return Ok(());
        }
        // SAFETY: as the caller promises.
        let plane = unsafe { *planes.add(at) };
        // SAFETY: as the caller promises.
        values.copy_from_slice(unsafe { std::slice::from_raw_parts(plane, values.len()) });
        match values.iter().position(|x| !x.is_finite()) {
            Some(index) => Err(Failure::new(
                NSP_ERROR_NOT_FINITE,
                format!("number {index} of plane {at}, {}, is not finite", PLANES[at]),
            )),
            None => Ok(()),
        }
    };
    fill(0, bytemuck::cast_slice_mut(gaussians.means_mut()))?;
    fill(1, bytemuck::cast_slice_mut(gaussians.quats_mut()))?;
    fill(2, bytemuck::cast_slice_mut(gaussians.log_scales_mut()))?;
    fill(3, gaussians.raw_opacities_mut())?;
    fill(4, bytemuck::cast_slice_mut(gaussians.dc_mut()))?;
    fill(5, bytemuck::cast_slice_mut(gaussians.rest_mut()))?;
    Ok(gaussians)
}

/// Joins models into one, each moved by a rigid transform (three rows of four), so that all splats are sorted
/// together. The near plane is that of the first model. All have the same kind of colours and the same alpha limit.
///
/// # Safety
/// `models` and `poses` are NULL or hold `count` of each.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_model_join(
    device: *mut NspDevice,
    models: *const *const NspModel,
    poses: *const [f64; 12],
    count: u32,
    model: *mut *mut NspModel,
) -> NspResult {
    guard("nsp_model_join", || {
        // SAFETY: as the caller promises.
        unsafe {
            give(model, "model", || {
                let gpu = object(device, "device")?.0.get("the device")?;
                if count == 0 || models.is_null() || poses.is_null() {
                    return Err(Failure::usage("no models: pass at least one, and its pose"));
                }
                let models = std::slice::from_raw_parts(models, count as usize);
                let poses = std::slice::from_raw_parts(poses, count as usize);
                let mut parts = vec![];
                for (at, (model, pose)) in models.iter().zip(poses).enumerate() {
                    let loaded = object(*model, &format!("models[{at}]"))?.0.get("a model")?;
                    parts.push((&loaded.model, affine(pose)));
                }
                NspModel::new(gpu, Model::join(&parts)?)
            })
        }
    })
}

/// The number of Gaussians; 0 for NULL.
///
/// # Safety
/// `model` is NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_model_count(model: *const NspModel) -> u32 {
    // SAFETY: as the caller promises.
    let model = unsafe { model.as_ref() };
    let loaded = model.and_then(|model| model.0.get("the model").ok());
    loaded.map_or(0, |loaded| loaded.model.gaussians.count as u32)
}

/// Writes the properties of a model to `info`.
///
/// # Safety
/// `model` and `info` are NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_model_info(
    model: *const NspModel,
    info: *mut NspModelInfo,
) -> NspResult {
    guard("nsp_model_info", || {
        // SAFETY: as the caller promises.
        let LoadedModel { model, .. } = unsafe { object(model, "model")? }.0.get("the model")?;
        let filled = NspModelInfo {
            struct_size: size_of::<NspModelInfo>(),
            count: model.gaussians.count as u32,
            sh_degree: model.gaussians.shape.sh_degree,
            near_plane: model.near,
            max_alpha: model.max_alpha,
            raw_colors: model.raw_colors.into(),
            law_stops: model.law.map_or(f32::NAN, |law| law.stops()),
            origin: model.gaussians.origin.to_array(),
        };
        // SAFETY: as the caller promises.
        unsafe { write(info, &filled) }
    })
}

/// Destroys a model; frames that show it may be in flight.
///
/// # Safety
/// `model` is NULL or valid, and not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_model_destroy(model: *mut NspModel) {
    // SAFETY: as the caller promises.
    unsafe { destroy("nsp_model_destroy", model) }
}
