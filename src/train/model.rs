//! The Gaussians in training, on the device.

use crate::Result;
use crate::gpu::{Buffer, Gpu};
use crate::optimizer::Moments;
use crate::scene::{Gaussians, width};

/// Planes of every attribute, their gradients and moments, and the statistics of density control.
#[derive(Debug)]
pub(super) struct Model {
    pub(super) count: usize,
    pub(super) sh_degree: u32,
    /// (columns x count)
    pub(super) parameters: Buffer<f32>,
    pub(super) gradients: Buffer<f32>,
    pub(super) moments: Moments,
    /// (count)
    pub(super) grad_norm_sums: Buffer<f32>,
    pub(super) visit_counts: Buffer<u32>,
}

impl Model {
    /// # Errors
    /// The device is out of memory or lost.
    pub(super) fn upload(gpu: &Gpu, gaussians: &Gaussians) -> Result<Self> {
        let len = gaussians.parameters.len();
        Ok(Self {
            count: gaussians.count,
            sh_degree: gaussians.sh_degree,
            parameters: gpu.buffer("parameters", &gaussians.parameters)?,
            gradients: gpu.zeros("gradients", len)?,
            moments: Moments::zeros(gpu, len)?,
            grad_norm_sums: gpu.zeros("grad_norm_sums", gaussians.count)?,
            visit_counts: gpu.zeros("visit_counts", gaussians.count)?,
        })
    }

    /// # Errors
    /// The device was lost.
    pub(super) fn download(&self, gpu: &Gpu) -> Result<Gaussians> {
        let parameters = gpu.read(&self.parameters)?;
        Ok(Gaussians { count: self.count, sh_degree: self.sh_degree, parameters })
    }

    /// Floats per Gaussian.
    pub(super) fn columns(&self) -> u32 {
        width(self.sh_degree) as u32
    }
}
