//! The Gaussians in training, on the device.

use glam::Vec3;

use super::Trainer;
use crate::Result;
use crate::batches::Batches;
use crate::densify::{Densifier, DensifyInputs, DensifyReport, DeviceGaussians, Round};
use crate::gpu::{Buffer, Gpu, Recorder};
use crate::optimizer::{Adam, AdamBuffers, FiniteCheck, LearningRates, Moments};
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
        let Gaussians { count, shape, ref parameters } = *gaussians;
        let (column_count, feature_count) = (width(shape), shape.features.width());
        let batches = Batches::new(gpu, count, [column_count, feature_count]);
        let zeros = |name| batches.zeros(gpu, name);
        let gaussians = DeviceGaussians {
            count: count as u32,
            column_count: column_count as u32,
            feature_count: feature_count as u32,
            parameters: batches.upload(gpu, "parameters", parameters)?,
            moments: Moments { first: zeros("first_moments")?, second: zeros("second_moments")? },
        };
        Ok(Self {
            shape,
            gradients: zeros("gradients")?,
            grad_norm_sums: gpu.zeros("grad_norm_sums", count)?,
            visit_counts: gpu.zeros("visit_counts", count)?,
            gaussians,
        })
    }

    /// A model of zeros, to be overwritten.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub(super) fn zeros(gpu: &Gpu, count: usize, shape: Shape) -> Result<Self> {
        Self::upload(gpu, &Gaussians { count, shape, parameters: vec![0.0; count * width(shape)] })
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

    /// Records a step of Adam, over the columns that the SH degree in use leaves: coefficients beyond have no gradient and no
    /// moments, so there is nothing to update. Nothing changes while the first element of `status` is not zero.
    ///
    /// # Errors
    /// A pass exceeds what the device launches.
    pub(super) fn update(
        &mut self,
        (gpu, pass): (&Gpu, &mut Recorder<'_>),
        adam: &Adam,
        step: u64,
        rates: &LearningRates,
        sh_degree: u32,
        status: &Buffer<u32>,
    ) -> Result<()> {
        let gaussians = &self.gaussians;
        let features = gaussians.feature_count;
        let columns =
            if sh_degree == 0 { width(0) as u32 + features } else { gaussians.column_count };
        gaussians.batches(gpu).iter().try_for_each(|batch| {
            let Moments { first, second } = &gaussians.moments;
            let buffers = AdamBuffers {
                parameters: &mut batch.of_planes(&gaussians.parameters)?,
                gradients: &batch.of_planes(&self.gradients)?,
                moments: &mut Moments {
                    first: batch.of_planes(first)?,
                    second: batch.of_planes(second)?,
                },
            };
            let shape = [batch.gaussian_count(), columns, features];
            adam.record(pass, step, rates, shape, buffers, status)
        })
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
        let batches = self.gaussians.batches(gpu);
        let DeviceGaussians { count, parameters, moments, .. } = &mut self.gaussians;
        let (count, shape) = (*count as usize, self.shape);
        for buffer in [parameters, &mut moments.first, &mut moments.second] {
            let mut gaussians = Gaussians { count, shape, parameters: batches.read(gpu, buffer)? };
            let coefficients = rest_coefficients(shape.sh_degree).max(1);
            for own in gaussians.rest_mut().chunks_mut(coefficients) {
                own.iter_mut().skip(kept).for_each(|rest| *rest = Vec3::ZERO);
            }
            batches.write(gpu, buffer, &gaussians.parameters)?;
        }
        Ok(())
    }

    /// Where the first parameter is that is NaN or infinite, among the planes of all Gaussians.
    ///
    /// # Errors
    /// The device was lost.
    pub(super) fn first_not_finite(
        &self,
        gpu: &Gpu,
        finite: &mut FiniteCheck,
    ) -> Result<Option<usize>> {
        let batches = self.gaussians.batches(gpu);
        let mut before = 0;
        for batch in batches.iter() {
            let planes = batch.of_planes(&self.gaussians.parameters)?;
            if let Some(at) = finite.first(gpu, &planes, planes.len())? {
                return Ok(Some(batches.place_of(before + at)));
            }
            before += planes.len();
        }
        Ok(None)
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
        let parameters = self.gaussians.batches(gpu).read(gpu, buffer)?;
        Ok(Gaussians { count: self.count(), shape: self.shape, parameters })
    }
}
