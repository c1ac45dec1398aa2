//! The Gaussians in training, on the device.

use glam::Vec3;

use super::Trainer;
use crate::Result;
use crate::densify::{Densifier, DensifyInputs, DensifyReport, DeviceGaussians, Round};
use crate::gpu::{Buffer, Gpu};
use crate::optimizer::Moments;
use crate::scene::{ATTRIBUTES, Gaussians, Shape, rest_coefficients, width};

impl Trainer {
    /// The gradient of every parameter that the last step left, in the frame.
    ///
    /// # Errors
    /// The device was lost.
    pub fn gradients(&self) -> Result<Gaussians> {
        self.model.planes(&self.gpu, &self.model.gradients)
    }
}

/// Planes of every attribute with their moments and gradients, and the statistics of density control. Buffers are as long
/// as the Gaussians need or longer.
#[derive(Debug)]
pub(super) struct Model {
    pub(super) gaussians: DeviceGaussians,
    shape: Shape,
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
            column_count: width(gaussians.shape) as u32,
            feature_count: gaussians.shape.features.width() as u32,
            parameters: gpu.buffer("parameters", &gaussians.parameters)?,
            moments: Moments::zeros(gpu, gaussians.parameters.len())?,
        };
        Self::new(gpu, on_device, gaussians.shape)
    }

    /// A model of zeros, to be overwritten.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub(super) fn zeros(gpu: &Gpu, count: usize, shape: Shape) -> Result<Self> {
        Self::upload(gpu, &Gaussians { count, shape, parameters: vec![0.0; count * width(shape)] })
    }

    fn new(gpu: &Gpu, gaussians: DeviceGaussians, shape: Shape) -> Result<Self> {
        let count = gaussians.count as usize;
        Ok(Self {
            shape,
            gradients: gpu.zeros("gradients", gaussians.parameters.len())?,
            grad_norm_sums: gpu.zeros("grad_norm_sums", count)?,
            visit_counts: gpu.zeros("visit_counts", count)?,
            gaussians,
        })
    }

    pub(super) fn shape(&self) -> Shape {
        self.shape
    }

    pub(super) fn count(&self) -> usize {
        self.gaussians.count as usize
    }

    /// How many Gaussians the buffers have room for.
    pub(super) fn capacity(&self) -> usize {
        self.grad_norm_sums.len()
    }

    /// One round of density control; the statistics begin anew.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub(super) fn densify(
        &mut self,
        gpu: &Gpu,
        densifier: &mut Densifier,
        round: Round,
    ) -> Result<DensifyReport> {
        let inputs = DensifyInputs {
            grad_norm_sums: &mut self.grad_norm_sums,
            visit_counts: &mut self.visit_counts,
            gradients: &mut self.gradients,
        };
        let report = densifier.densify(&mut self.gaussians, inputs, round)?;
        gpu.run("clear_statistics", |pass| {
            pass.fill(&mut self.grad_norm_sums, 0);
            pass.fill(&mut self.visit_counts, 0);
            Ok(())
        })?;
        Ok(report)
    }

    /// Makes every SH coefficient above a degree zero, and what Adam keeps of them.
    ///
    /// # Errors
    /// The device was lost.
    pub(super) fn drop_degrees_above(&mut self, gpu: &Gpu, degree: u32) -> Result<()> {
        let kept = rest_coefficients(degree);
        let DeviceGaussians { count, parameters, moments, .. } = &mut self.gaussians;
        let (count, shape) = (*count as usize, self.shape);
        for buffer in [parameters, &mut moments.first, &mut moments.second] {
            let mut values = gpu.read(buffer)?;
            let spare = values.split_off(count * width(shape));
            let mut gaussians = Gaussians { count, shape, parameters: values };
            let coefficients = rest_coefficients(shape.sh_degree).max(1);
            for own in gaussians.rest_mut().chunks_mut(coefficients) {
                own.iter_mut().skip(kept).for_each(|rest| *rest = Vec3::ZERO);
            }
            gaussians.parameters.extend(spare);
            gpu.write(buffer, &gaussians.parameters)?;
        }
        Ok(())
    }

    /// The attribute and the Gaussian that the parameter at an index belongs to.
    pub(super) fn place_of(&self, parameter: usize) -> (String, usize) {
        let none = Gaussians { count: self.count(), shape: self.shape, parameters: vec![] };
        let planes = ATTRIBUTES.iter().map(|spec| (spec, none.plane(spec.attribute)));
        let within = planes.into_iter().find(|(_, plane)| plane.contains(&parameter));
        within.map_or_else(
            || ("parameters".to_owned(), parameter),
            |(spec, plane)| {
                let width = plane.len() / self.count().max(1);
                (spec.name.to_owned(), (parameter - plane.start) / width.max(1))
            },
        )
    }

    /// # Errors
    /// The device was lost.
    pub(super) fn download(&self, gpu: &Gpu) -> Result<Gaussians> {
        self.planes(gpu, &self.gaussians.parameters)
    }

    fn planes(&self, gpu: &Gpu, buffer: &Buffer<f32>) -> Result<Gaussians> {
        let mut parameters = gpu.read(buffer)?;
        parameters.truncate(self.count() * width(self.shape));
        Ok(Gaussians { count: self.count(), shape: self.shape, parameters })
    }
}
