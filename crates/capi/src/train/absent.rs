//! A build without training: every function is refused with `NSP_ERROR_UNSUPPORTED`.

use std::ffi::c_char;

use nightsplat::Instance;

use super::{NspScore, NspStep, NspTrainer, NspWatch};
use crate::device::NspDevice;
use crate::error::{Failure, NSP_ERROR_UNSUPPORTED};
use crate::model::NspModel;

/// There is no trainer.
pub(super) type Training = std::convert::Infallible;

fn unsupported<T>() -> Result<T, Failure> {
    let text = "this build cannot train; build the library with feature train";
    Err(Failure::new(NSP_ERROR_UNSUPPORTED, text))
}

pub(super) fn begin(
    _: *mut NspDevice,
    _: *const c_char,
    _: *const c_char,
    _: *const NspWatch,
) -> Result<NspTrainer, Failure> {
    unsupported()
}

pub(super) fn advance(
    _: &mut NspTrainer,
    _: u64,
    _: u32,
    _: *mut NspStep,
    _: *mut u32,
) -> Result<(), Failure> {
    unsupported()
}

pub(super) fn has_ended(_: &NspTrainer) -> Result<bool, Failure> {
    unsupported()
}

pub(super) fn scores(_: &NspTrainer, _: *mut NspScore, _: &mut u32) -> Result<(), Failure> {
    unsupported()
}

pub(super) fn checkpoint(_: &mut NspTrainer, _: *const c_char) -> Result<(), Failure> {
    unsupported()
}

pub(crate) fn live(_: &NspTrainer) -> Result<Instance<'_>, Failure> {
    unsupported()
}

pub(super) fn current(_: &mut NspTrainer) -> Result<NspModel, Failure> {
    unsupported()
}

pub(super) fn save(_: &mut NspTrainer, _: *const c_char) -> Result<(), Failure> {
    unsupported()
}
