//! The networks: their kernels, their gradients, `PyTorch`'s view of them, their files.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

#[macro_use]
#[path = "../common/mod.rs"]
mod common;

mod files;
mod gradients;
mod kernels;
mod model;
mod networks;
mod torch;

fn largest(values: &[f32]) -> f32 {
    values.iter().fold(0.0, |largest, value| value.abs().max(largest))
}

fn narrow(values: &[f64]) -> Vec<f32> {
    values.iter().map(|&x| x as f32).collect()
}

fn widen(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&x| x.into()).collect()
}
