//! What the functions do that train.

use std::ffi::c_char;
use std::time::Duration;

use nightsplat::Instance;
use nightsplat::gpu::Gpu;
use nightsplat::train::Trainer;

use super::{NspStep, NspTrainer};
use crate::device::NspDevice;
use crate::error::{Failure, Object};
use crate::model::NspModel;
use crate::structs::{object, text, write_all};

/// The state of a trainer.
pub(super) type Training = Object<TrainerOnDevice>;

#[derive(Debug)]
pub(super) struct TrainerOnDevice {
    gpu: Gpu,
    trainer: Trainer,
}

/// # Safety
/// As [`nsp_trainer_create`](super::nsp_trainer_create).
pub(super) unsafe fn begin(
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
    Ok(NspTrainer(Object::new(TrainerOnDevice { gpu: gpu.clone(), trainer })))
}

/// # Safety
/// As [`nsp_trainer_advance`](super::nsp_trainer_advance).
pub(super) unsafe fn advance(
    trainer: &mut NspTrainer,
    until: u64,
    milliseconds: u32,
    steps: *mut NspStep,
    count: *mut u32,
) -> Result<(), Failure> {
    trainer.0.with("the trainer", |TrainerOnDevice { trainer, .. }| {
        let milliseconds = if milliseconds == 0 { 500 } else { milliseconds };
        let budget = Duration::from_millis(milliseconds.into());
        let ended = trainer.has_ended();
        let reports = if ended { vec![] } else { trainer.advance_within(until, budget)? };
        let gaussians = trainer.gaussian_count() as u32;
        // SAFETY: as the caller promises.
        let Some(count) = (unsafe { count.as_mut() }) else { return Ok(()) };
        let taken = if steps.is_null() { 0 } else { reports.len().min(*count as usize) };
        let last = &reports[reports.len() - taken..];
        let struct_size = size_of::<NspStep>();
        let all = last.iter().map(|report| {
            let (step, loss) = (report.step, report.loss);
            NspStep { struct_size, step, loss, gaussians, reserved: 0 }
        });
        // SAFETY: as the caller promises.
        unsafe { write_all(steps, all) }?;
        *count = taken as u32;
        Ok(())
    })
}

/// # Safety
/// As [`nsp_trainer_checkpoint`](super::nsp_trainer_checkpoint).
pub(super) unsafe fn checkpoint(
    trainer: &mut NspTrainer,
    path: *const c_char,
) -> Result<(), Failure> {
    // SAFETY: as the caller promises.
    let path = unsafe { text(path, "path")? };
    trainer.0.with("the trainer", |TrainerOnDevice { trainer, .. }| {
        Ok(trainer.save_checkpoint(path.as_ref())?)
    })
}

/// The Gaussians as they are now.
pub(crate) fn live(trainer: &NspTrainer) -> Result<Instance<'_>, Failure> {
    Ok(trainer.0.get("the trainer")?.trainer.live())
}

pub(super) fn current(trainer: &mut NspTrainer) -> Result<NspModel, Failure> {
    trainer.0.with("the trainer", |TrainerOnDevice { gpu, trainer }| {
        NspModel::new(gpu, trainer.model()?)
    })
}

/// # Safety
/// As [`nsp_trainer_save`](super::nsp_trainer_save).
pub(super) unsafe fn save(trainer: &mut NspTrainer, path: *const c_char) -> Result<(), Failure> {
    // SAFETY: as the caller promises.
    let path = unsafe { text(path, "path")? };
    trainer
        .0
        .with("the trainer", |TrainerOnDevice { trainer, .. }| Ok(trainer.model()?.save(path)?))
}
