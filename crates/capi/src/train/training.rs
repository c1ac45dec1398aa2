//! What the functions do that train.

use std::ffi::c_char;
use std::time::Duration;

use nightsplat::Instance;
use nightsplat::gpu::Gpu;
use nightsplat::train::Trainer;
use nightsplat_core::watch::Watch;

use super::{NspScore, NspStep, NspTrainer, NspWatch};
use crate::device::NspDevice;
use crate::error::{Failure, Object};
use crate::model::NspModel;
use crate::structs::{object, text, write_all};

/// The state of a trainer.
pub(super) type Training = Object<TrainerOnDevice>;

#[derive(Debug)]
pub(super) struct TrainerOnDevice {
    gpu: Gpu,
    watch: Watch,
    trainer: Trainer,
}

/// # Safety
/// As [`nsp_trainer_create`](super::nsp_trainer_create).
pub(super) unsafe fn begin(
    device: *mut NspDevice,
    dataset: *const c_char,
    config_toml: *const c_char,
    watch: *const NspWatch,
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
    // SAFETY: as the caller promises.
    let watch = unsafe { watch.as_ref() }.map(|watch| watch.0.clone()).unwrap_or_default();
    let trainer = watch.during(|| Trainer::with_settings(gpu, dataset, config))?;
    Ok(NspTrainer(Object::new(TrainerOnDevice { gpu: gpu.clone(), watch, trainer })))
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
    trainer.0.with("the trainer", |TrainerOnDevice { watch, trainer, .. }| {
        let milliseconds = if milliseconds == 0 { 500 } else { milliseconds };
        let budget = Duration::from_millis(milliseconds.into());
        let until = if trainer.has_ended() { trainer.steps_done() } else { until };
        let reports = match trainer.has_ended() && !trainer.is_due() {
            true => vec![],
            false => watch.during(|| trainer.advance_within(until, budget))?,
        };
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

pub(super) fn has_ended(trainer: &NspTrainer) -> Result<bool, Failure> {
    let trainer = &trainer.0.get("the trainer")?.trainer;
    Ok(trainer.has_ended() && !trainer.is_due())
}

/// # Safety
/// As [`nsp_trainer_scores`](super::nsp_trainer_scores).
pub(super) unsafe fn scores(
    trainer: &NspTrainer,
    scores: *mut NspScore,
    count: &mut u32,
) -> Result<(), Failure> {
    let all: Vec<(u64, f64)> = trainer.0.get("the trainer")?.trainer.held_out_scores().collect();
    let taken = if scores.is_null() { 0 } else { all.len().min(*count as usize) };
    let struct_size = size_of::<NspScore>();
    let last = all[all.len() - taken..].iter();
    // SAFETY: as the caller promises.
    unsafe { write_all(scores, last.map(|&(step, psnr)| NspScore { struct_size, step, psnr })) }?;
    *count = taken as u32;
    Ok(())
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
    trainer.0.with("the trainer", |TrainerOnDevice { gpu, trainer, .. }| {
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
