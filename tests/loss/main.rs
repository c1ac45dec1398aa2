//! The loss terms: kernels against their references, gradients against finite differences and `PyTorch`, edge cases.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[macro_use]
#[path = "../common/mod.rs"]
mod common;

mod denoising;
mod depth;
mod image;
mod log;
mod normals;
mod parameters;
mod structure;

mod exposed_training;
mod masks;
mod view_exposures;

use common::{largest, widen};
use nightsplat::Result;
use nightsplat::gpu::{Buffer, Recorder};
use nightsplat::kernels::status::{STATUS_NOT_FINITE as NOT_FINITE, STATUS_WORDS};
use nightsplat::loss::{LogSlot, LossLog, StepLosses, Term, TermInputs};

use crate::common::prelude::*;

/// The terms of one step in the log.
struct Logged {
    losses: StepLosses,
    status: u32,
}

/// Records terms into the middle of three slots; the others must not change.
fn log_step(
    gpu: &Gpu,
    record: impl FnOnce(&mut Recorder<'_>, &mut LogSlot<'_>) -> Result<()>,
) -> Result<Logged> {
    let mut log = LossLog::new(gpu, 3)?;
    let mut status = gpu.zeros("status", STATUS_WORDS as usize)?;
    let mut download = None;
    gpu.run("losses", |pass| {
        let mut slot = LogSlot { log: &mut log, slot: 1, status: &mut status };
        record(pass, &mut slot)?;
        download = Some(log.download(pass)?);
        Ok(())
    })?;
    let steps = download.unwrap().wait()?;
    assert_eq!(steps.len(), 3);
    for other in [&steps[0], &steps[2]] {
        assert!(Term::all().all(|term| other.get(term) == 0.0) && other.status == 0);
    }
    let status = gpu.read(&status)?[0];
    assert_eq!(steps[1].status, status);
    Ok(Logged { losses: steps[1].clone(), status })
}

/// A step of a term on the first view and a render with these features.
fn term_inputs(size: UVec2, features: Features, render: &Buffer<f32>, step: u64) -> TermInputs<'_> {
    TermInputs {
        step,
        view: 0,
        size,
        features,
        render,
        transmittances: render,
        colors: render,
        target: render,
    }
}

/// Prints the first mismatches, so that a failure shows its pattern.
fn assert_close(what: &str, actual: &[f32], expected: &[f32], tolerance: f32) {
    common::assert_close(what, actual, expected, |_, _| tolerance);
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|value| value.to_bits()).collect()
}

/// Reproducible values between `low` and `high`.
fn noise(seed: u64, count: usize, low: f64, high: f64) -> Vec<f32> {
    let mut random = Random::new(seed);
    (0..count).map(|_| random.between(low, high) as f32).collect()
}

/// The derivative of `loss` with respect to every element of `at`, by central differences.
fn central_differences(at: &[f64], loss: impl Fn(&[f64]) -> f64) -> Vec<f64> {
    let h = 1e-6;
    let mut shifted = at.to_vec();
    (0..at.len())
        .map(|i| {
            let mut at_offset = |offset: f64| {
                shifted[i] = at[i] + offset;
                loss(&shifted)
            };
            let difference = at_offset(h) - at_offset(-h);
            shifted[i] = at[i];
            difference / (2.0 * h)
        })
        .collect()
}

/// Compares the gradient of a reference with finite differences.
fn assert_gradient(what: &str, analytic: &[f32], numeric: &[f64]) {
    let numeric = common::narrow(numeric);
    assert_close(what, analytic, &numeric, 1e-5 * largest(&numeric) + 1e-9);
}

/// `PyTorch`'s values of the losses.
struct Torch(BTreeMap<String, Vec<f32>>);

impl Torch {
    fn read() -> Self {
        Self(common::safetensors::read("tests/fixtures/torch/losses.safetensors"))
    }

    fn get(&self, name: &str) -> &[f32] {
        &self.0[name]
    }

    /// A value to a relative 1e-4, a gradient to 1e-4 of its largest element.
    fn assert_agrees(&self, name: &str, actual: &[f32]) {
        let expected = self.get(name);
        assert_close(name, actual, expected, 1e-4 * largest(expected));
    }
}
