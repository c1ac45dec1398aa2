//! Training on a device, in a build with feature `train`.

#[cfg(feature = "train")]
mod training;
#[cfg(not(feature = "train"))]
#[path = "train/absent.rs"]
mod training;

use std::ffi::c_char;

use super::device::NspDevice;
use super::error::{NspResult, guard};
use super::model::NspModel;
use super::structs::{Sized0, destroy, give, object_mut};
pub(super) use training::live;
use training::{Training, advance, begin, checkpoint, current, save};

/// A training run. Use it from one thread at a time.
#[derive(Debug)]
pub struct NspTrainer(Training);

/// A training step.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspStep {
    /// `sizeof(NspStep)`; of the first of an array, the distance between its elements.
    pub struct_size: usize,
    /// Counted from 1.
    pub step: u64,
    /// The weighted sum of its loss terms.
    pub loss: f64,
    /// The number of Gaussians.
    pub gaussians: u32,
    /// Unused.
    pub reserved: u32,
}

// SAFETY: the size comes first; the rest are numbers.
unsafe impl Sized0 for NspStep {
    const NAME: &'static str = "NspStep";
    const FIRST_SIZE: usize = size_of::<Self>();
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

/// Trains for about `milliseconds`, up to step `until` at most; 0 stands for 500. Density control and the scores of
/// held-out views, where they are due, come on top. Writes the last of these steps to `steps`, at most `*count`, and
/// their number to `*count`; both may be NULL. No step: `until` is reached, or the training has ended.
///
/// # Safety
/// `trainer` is NULL or valid; `steps` holds `*count`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_trainer_advance(
    trainer: *mut NspTrainer,
    until: u64,
    milliseconds: u32,
    steps: *mut NspStep,
    count: *mut u32,
) -> NspResult {
    guard("nsp_trainer_advance", || {
        // SAFETY: as the caller promises.
        unsafe { advance(object_mut(trainer, "trainer")?, until, milliseconds, steps, count) }
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

/// Writes a checkpoint of the training, from which `nightsplat train --resume` goes on, if a run directory has it.
///
/// # Safety
/// `trainer` is NULL or valid; `path` is NULL or ends with NUL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_trainer_checkpoint(
    trainer: *mut NspTrainer,
    path: *const c_char,
) -> NspResult {
    guard("nsp_trainer_checkpoint", || {
        // SAFETY: as the caller promises.
        unsafe { checkpoint(object_mut(trainer, "trainer")?, path) }
    })
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

/// Destroys a trainer; waits for its submissions.
///
/// # Safety
/// `trainer` is NULL or valid, and not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_trainer_destroy(trainer: *mut NspTrainer) {
    // SAFETY: as the caller promises.
    unsafe { destroy("nsp_trainer_destroy", trainer) }
}
