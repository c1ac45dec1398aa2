//! Training on a device, in a build with feature `io`.

use std::ffi::c_char;

use super::device::NspDevice;
#[cfg(not(feature = "io"))]
use super::error::NSP_ERROR_UNSUPPORTED;
use super::error::{Failure, NspResult, guard};
use super::model::NspModel;
use super::structs::{destroy, give, object_mut};
#[cfg(feature = "io")]
use super::{
    error::Object,
    structs::{object, text},
};
#[cfg(feature = "io")]
use crate::gpu::Gpu;
#[cfg(feature = "io")]
use crate::train::Trainer;

/// A training run. Use it from one thread at a time.
#[derive(Debug)]
pub struct NspTrainer(
    #[cfg(feature = "io")] Object<Training>,
    #[cfg(not(feature = "io"))] std::convert::Infallible,
);

#[cfg(feature = "io")]
#[derive(Debug)]
struct Training {
    gpu: Gpu,
    trainer: Trainer,
}

/// A training step.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspStep {
    /// Counted from 1.
    pub step: u64,
    /// The weighted sum of its loss terms.
    pub loss: f64,
    /// The number of Gaussians.
    pub gaussians: u32,
    /// Unused.
    pub reserved: u32,
}

#[cfg(not(feature = "io"))]
fn unsupported<T>() -> Result<T, Failure> {
    let text = "this build cannot train; build the library with feature io";
    Err(Failure::new(NSP_ERROR_UNSUPPORTED, text))
}

/// Creates a trainer for the dataset in a folder. `config_toml` is text in the format of config.toml; NULL or empty:
/// the settings follow from the photographs. The device must not be record-only.
///
/// # Safety
/// The texts are NULL or end with NUL; the pointers are NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_trainer_create(
    device: *mut NspDevice,
    dataset: *const c_char,
    config_toml: *const c_char,
    trainer: *mut *mut NspTrainer,
) -> NspResult {
    guard("nsp_trainer_create", || {
        // SAFETY: as the caller promises.
        unsafe { give(trainer, "trainer", || begin(device, dataset, config_toml)) }
    })
}

#[cfg(not(feature = "io"))]
unsafe fn begin(
    _: *mut NspDevice,
    _: *const c_char,
    _: *const c_char,
) -> Result<NspTrainer, Failure> {
    unsupported()
}

/// # Safety
/// As [`nsp_trainer_create`].
#[cfg(feature = "io")]
unsafe fn begin(
    device: *mut NspDevice,
    dataset: *const c_char,
    config_toml: *const c_char,
) -> Result<NspTrainer, Failure> {
    // SAFETY: as the caller promises.
    let (gpu, dataset, config) = unsafe {
        let config = if config_toml.is_null() { "" } else { text(config_toml, "config_toml")? };
        (object(device, "device")?.0.get("the device")?, text(dataset, "dataset")?, config)
    };
    if gpu.is_record_only() {
        return Err(Failure::usage(
            "a record-only device cannot train; lend its queue with a lock",
        ));
    }
    let trainer = Trainer::with_settings(gpu, dataset, config)?;
    Ok(NspTrainer(Object::new(Training { gpu: gpu.clone(), trainer })))
}

/// Trains for about half a second, up to step `until` at most. Writes the last of these steps to `steps`, at most
/// `*count`, and their number to `*count`; both may be NULL. No step: `until` is reached, or the training has ended.
///
/// # Safety
/// `trainer` is NULL or valid; `steps` holds `*count`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_trainer_advance(
    trainer: *mut NspTrainer,
    until: u64,
    steps: *mut NspStep,
    count: *mut u32,
) -> NspResult {
    guard("nsp_trainer_advance", || {
        // SAFETY: as the caller promises.
        unsafe { advance(object_mut(trainer, "trainer")?, until, steps, count) }
    })
}

#[cfg(not(feature = "io"))]
unsafe fn advance(_: &mut NspTrainer, _: u64, _: *mut NspStep, _: *mut u32) -> Result<(), Failure> {
    unsupported()
}

/// # Safety
/// As [`nsp_trainer_advance`].
#[cfg(feature = "io")]
unsafe fn advance(
    trainer: &mut NspTrainer,
    until: u64,
    steps: *mut NspStep,
    count: *mut u32,
) -> Result<(), Failure> {
    trainer.0.with("the trainer", |Training { trainer, .. }| {
        let reports = if trainer.has_ended() { vec![] } else { trainer.advance(until)? };
        let gaussians = trainer.gaussian_count() as u32;
        // SAFETY: as the caller promises.
        let Some(count) = (unsafe { count.as_mut() }) else { return Ok(()) };
        let taken = if steps.is_null() { 0 } else { reports.len().min(*count as usize) };
        let last = &reports[reports.len() - taken..];
        for (at, report) in last.iter().enumerate() {
            let step = NspStep { step: report.step, loss: report.loss, gaussians, reserved: 0 };
            // SAFETY: as the caller promises.
            unsafe { steps.add(at).write(step) };
        }
        *count = taken as u32;
        Ok(())
    })
}

/// Copies the current model, on the trainer's device.
///
/// # Safety
/// The pointers are NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_trainer_model(
    trainer: *mut NspTrainer,
    model: *mut *mut NspModel,
) -> NspResult {
    guard("nsp_trainer_model", || {
        // SAFETY: as the caller promises.
        unsafe { give(model, "model", || current(object_mut(trainer, "trainer")?)) }
    })
}

#[cfg(not(feature = "io"))]
fn current(_: &mut NspTrainer) -> Result<NspModel, Failure> {
    unsupported()
}

#[cfg(feature = "io")]
fn current(trainer: &mut NspTrainer) -> Result<NspModel, Failure> {
    trainer.0.with("the trainer", |Training { gpu, trainer }| NspModel::new(gpu, trainer.model()?))
}

/// Saves the current model in the format of the path's extension: `.ply`, `.spz`, `.sog` or `.glb`.
///
/// # Safety
/// `trainer` is NULL or valid; `path` is NULL or ends with NUL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_trainer_save(
    trainer: *mut NspTrainer,
    path: *const c_char,
) -> NspResult {
    guard("nsp_trainer_save", || {
        // SAFETY: as the caller promises.
        unsafe { save(object_mut(trainer, "trainer")?, path) }
    })
}

#[cfg(not(feature = "io"))]
unsafe fn save(_: &mut NspTrainer, _: *const c_char) -> Result<(), Failure> {
    unsupported()
}

/// # Safety
/// As [`nsp_trainer_save`].
#[cfg(feature = "io")]
unsafe fn save(trainer: &mut NspTrainer, path: *const c_char) -> Result<(), Failure> {
    // SAFETY: as the caller promises.
    let path = unsafe { text(path, "path")? };
    trainer.0.with("the trainer", |Training { trainer, .. }| Ok(trainer.model()?.save(path)?))
}

/// Destroys a trainer; waits for its submissions.
///
/// # Safety
/// `trainer` is NULL or valid, and not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_trainer_destroy(trainer: *mut NspTrainer) {
    // SAFETY: as the caller promises.
    unsafe { destroy("nsp_trainer_destroy", trainer) }
}
