//! The Gaussians in training, on the device.

use crate::Result;
use crate::densify::{Densifier, DensifyReport, DeviceGaussians, GradientStatistics};
use crate::gpu::{Buffer, Gpu};
use crate::optimizer::Moments;
use crate::scene::{Gaussians, width};

/// Planes of every attribute with their moments and gradients, and the statistics of density control.
#[derive(Debug)]
pub(super) struct Model {
    pub(super) gaussians: DeviceGaussians,
    sh_degree: u32,
    /// As many as parameters.
    pub(super) gradients: Buffer<f32>,
    /// One per Gaussian each.
    pub(super) grad_norm_sums: Buffer<f32>,
    pub(super) visit_counts: Buffer<u32>,
}

impl Model {
    /// # Errors
    /// The device is out of memory or lost.
    pub(super) fn upload(gpu: &Gpu, gaussians: &Gaussians) -> Result<Self> {
        let on_device = DeviceGaussians {
            count: gaussians.count as u32,
            column_count: width(gaussians.sh_degree) as u32,
            parameters: gpu.buffer("parameters", &gaussians.parameters)?,
            moments: Moments::zeros(gpu, gaussians.parameters.len())?,
        };
        Self::new(gpu, on_device, gaussians.sh_degree)
    }

    fn new(gpu: &Gpu, gaussians: DeviceGaussians, sh_degree: u32) -> Result<Self> {
        let count = gaussians.count as usize;
        Ok(Self {
            sh_degree,
            gradients: gpu.zeros("gradients", gaussians.parameters.len())?,
            grad_norm_sums: gpu.zeros("grad_norm_sums", count)?,
            visit_counts: gpu.zeros("visit_counts", count)?,
            gaussians,
        })
    }

    pub(super) fn count(&self) -> usize {
        self.gaussians.count as usize
    }

    /// One pass of density control after `step`; the statistics begin anew.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub(super) fn densify(
        &mut self,
        gpu: &Gpu,
        densifier: &mut Densifier,
        step: u64,
    ) -> Result<DensifyReport> {
        let statistics = GradientStatistics {
            grad_norm_sums: &self.grad_norm_sums,
            visit_counts: &self.visit_counts,
        };
        let (gaussians, report) = densifier.densify(&self.gaussians, statistics, step)?;
        *self = Self::new(gpu, gaussians, self.sh_degree)?;
        Ok(report)
    }

    /// # Errors
    /// The device was lost.
    pub(super) fn download(&self, gpu: &Gpu) -> Result<Gaussians> {
        let parameters = gpu.read(&self.gaussians.parameters)?;
        Ok(Gaussians { count: self.count(), sh_degree: self.sh_degree, parameters })
    }
}
