//! Training on a device, in a build with feature `train`.

#[cfg(feature = "train")]
mod training;
#[cfg(not(feature = "train"))]
#[path = "train/absent.rs"]
mod training;

use std::ffi::{CString, c_char, c_void};

use nightsplat_core::watch::{Watch, WatchedProgress};

use super::device::NspDevice;
use super::error::{NspResult, guard};
use super::model::NspModel;
use super::structs::{Sized0, destroy, give, object, object_mut};
pub(super) use training::live;
use training::{Training, advance, begin, checkpoint, current, has_ended, save, scores};

/// Follows trainers and stops them, from any thread. Experimental.
#[derive(Debug)]
pub struct NspWatch(Watch);

/// A training run. Use it from one thread at a time. Experimental: what begins with `nsp_trainer` may change.
#[derive(Debug)]
pub struct NspTrainer(Training);

/// A training step. Experimental.
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

/// The mean score of the held-out views after a step. Experimental.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspScore {
    /// `sizeof(NspScore)`; of the first of an array, the distance between its elements.
    pub struct_size: usize,
    /// Counted from 1.
    pub step: u64,
    /// dB, against the targets of the views.
    pub psnr: f64,
}

// SAFETY: the size comes first; the rest are numbers.
unsafe impl Sized0 for NspScore {
    const NAME: &'static str = "NspScore";
    const FIRST_SIZE: usize = size_of::<Self>();
}

/// A host's pointer for its function.
struct User(*mut c_void);
// SAFETY: the host promises that its function may be called from any thread with it.
unsafe impl Send for User {}

/// Creates a watch. `progress` is called with a stage, such as "decoding photographs" or "training", how much of it is
/// done, and all of it: from any thread, by one at a time. It may call `nsp_watch_stop`, and nothing else of the
/// library. NULL: progress is not told.
///
/// # Safety
/// `progress` may be called with `user` as long as the watch or a trainer with it lives; `watch` is NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_watch_create(
    progress: Option<
        unsafe extern "C" fn(user: *mut c_void, stage: *const c_char, done: u64, all: u64),
    >,
    user: *mut c_void,
    watch: *mut *mut NspWatch,
) -> NspResult {
    guard("nsp_watch_create", || {
        let made = || {
            let Some(function) = progress else { return Ok(NspWatch(Watch::default())) };
            let user = User(user);
            let told = move |WatchedProgress { stage, done, all }: WatchedProgress| {
                let User(user) = { &user };
                let stage = CString::new(stage).unwrap_or_default();
                // SAFETY: as the host promises.
                unsafe { function(*user, stage.as_ptr(), done as u64, all as u64) };
            };
            Ok(NspWatch(Watch::new(told)))
        };
        // SAFETY: as the caller promises.
        unsafe { give(watch, "watch", made) }
    })
}

/// Stops the call of a trainer that is running with the watch, or the next: it returns `NSP_ERROR_STOPPED`, after a
/// call that reports the steps done so far where there are any. The trainer can go on afterwards. May be called from
/// any thread.
///
/// # Safety
/// `watch` is NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_watch_stop(watch: *const NspWatch) -> NspResult {
    guard("nsp_watch_stop", || {
        // SAFETY: as the caller promises.
        unsafe { object(watch, "watch")? }.0.stop();
        Ok(())
    })
}

/// Destroys a watch; trainers go on without it.
///
/// # Safety
/// `watch` is NULL or valid, and not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_watch_destroy(watch: *mut NspWatch) {
    // SAFETY: as the caller promises.
    unsafe { destroy("nsp_watch_destroy", watch) }
}

/// Creates a trainer for the dataset in a folder. `config_toml` is text in the format of config.toml; NULL or empty:
/// the settings follow from the photographs. `watch` follows this call and the training; NULL: none. The device must
/// not be record-only.
///
/// # Safety
/// The texts are NULL or end with NUL; the pointers are NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_trainer_create(
    device: *mut NspDevice,
    dataset: *const c_char,
    config_toml: *const c_char,
    watch: *const NspWatch,
    trainer: *mut *mut NspTrainer,
) -> NspResult {
    guard("nsp_trainer_create", || {
        // SAFETY: as the caller promises.
        unsafe { give(trainer, "trainer", || begin(device, dataset, config_toml, watch)) }
    })
}

/// Trains for about `milliseconds`, up to step `until` at most; 0 stands for 500. Writes the last of these steps to
/// `steps`, at most `*count`, and their number to `*count`; both may be NULL. There may be no step: held-out views are
/// scored in calls of their own, `until` is reached, or the training has ended.
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

/// Whether the last step is done and scored: 1; else 0.
///
/// # Safety
/// `trainer` is NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_trainer_has_ended(trainer: *const NspTrainer) -> u32 {
    let mut ended = 0;
    guard("nsp_trainer_has_ended", || {
        // SAFETY: as the caller promises.
        ended = has_ended(unsafe { object(trainer, "trainer")? })?.into();
        Ok(())
    });
    ended
}

/// Writes the last scores of the held-out views to `scores`, at most `*count`, and their number to `*count`.
///
/// # Safety
/// The pointers are NULL or valid; `scores` holds `*count`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_trainer_scores(
    trainer: *const NspTrainer,
    scores: *mut NspScore,
    count: *mut u32,
) -> NspResult {
    guard("nsp_trainer_scores", || {
        // SAFETY: as the caller promises.
        unsafe { self::scores(object(trainer, "trainer")?, scores, object_mut(count, "count")?) }
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
