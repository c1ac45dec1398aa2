//! The Gaussians in training, on the device.

use glam::Vec3;

use super::{PrecisionConfig, Trainer};
use crate::Result;
use crate::batches::Batches;
use crate::densify::{Densifier, DensifyInputs, DensifyReport, DeviceGaussians, Round};
use crate::gpu::{Buffer, Gpu, Recorder};
use crate::halves::Bits;
use crate::optimizer::{Adam, AdamBuffers, FiniteCheck, LearningRates};
use crate::scene::{ATTRIBUTES, Attribute, Gaussians, Shape, rest_coefficients, width};

impl Trainer {
    /// The gradient of every parameter that the last step left, in the frame.
    ///
    /// # Errors
    /// The device was lost.
    pub fn gradients(&self) -> Result<Gaussians> {
        let Model { gaussians, shape, gradients, .. } = &self.model;
        let parameters = gaussians.batches(&self.gpu).read(&self.gpu, gradients)?;
        Ok(Gaussians { count: self.model.count(), shape: *shape, parameters })
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
    pub(super) fn upload(
        gpu: &Gpu,
        gaussians: &Gaussians,
        precision: &PrecisionConfig,
    ) -> Result<Self> {
        let Gaussians { count, shape, ref parameters } = *gaussians;
        let (column_count, feature_count) = (width(shape), shape.features.width());
        let batches = Batches::new(gpu, count, [column_count, feature_count]);
        let bits = [precision.rest, precision.moments];
        let mut gaussians = DeviceGaussians::new(gpu, count, [column_count, feature_count], bits)?;
        gaussians.write(gpu, parameters)?;
        Ok(Self {
            shape,
            gradients: batches.zeros(gpu, "gradients")?,
            grad_norm_sums: gpu.zeros("grad_norm_sums", count)?,
            visit_counts: gpu.zeros("visit_counts", count)?,
            gaussians,
        })
    }

    /// A model of zeros, to be overwritten.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub(super) fn zeros(
        gpu: &Gpu,
        count: usize,
        shape: Shape,
        precision: &PrecisionConfig,
    ) -> Result<Self> {
        Self::upload(gpu, &Gaussians::zeros(count, shape), precision)
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
        let DeviceGaussians { column_count, feature_count, rest, .. } = *gaussians;
        let first = width(0) as u32 + feature_count;
        let of_floats = if sh_degree == 0 || rest == Bits::Half { first } else { column_count };
        gaussians.batches(gpu).iter().try_for_each(|batch| {
            let words = gaussians.parameter_columns();
            let parameters = &mut batch.of_rows(&gaussians.parameters, words)?;
            let gradients = &batch.of_planes(&self.gradients)?;
            let moments = &mut gaussians.moments.of_batch(&batch)?;
            let count = batch.gaussian_count();
            let buffers = AdamBuffers { parameters, gradients, moments };
            adam.record(pass, step, rates, [count, of_floats, feature_count], buffers, status)?;
            if sh_degree == 0 || rest == Bits::Single {
                return Ok(());
            }
            let buffers = AdamBuffers { parameters, gradients, moments };
            let rate = rates[Attribute::Rest];
            let halves = [count, first, column_count - first];
            adam.record_halves(pass, step, rate, halves, buffers, status)
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
        let shape = self.shape;
        let drop = |parameters: Vec<f32>| {
            let mut gaussians = Gaussians { count: self.count(), shape, parameters };
            let coefficients = rest_coefficients(shape.sh_degree).max(1);
            for own in gaussians.rest_mut().chunks_mut(coefficients) {
                own.iter_mut().skip(kept).for_each(|rest| *rest = Vec3::ZERO);
            }
            gaussians.parameters
        };
        let batches = self.gaussians.batches(gpu);
        let parameters = drop(self.gaussians.read(gpu)?);
        let moments = self.gaussians.moments.planes();
        let moments = moments.into_iter().map(|(_, plane)| Ok(drop(batches.read(gpu, plane)?)));
        let moments = moments.collect::<Result<Vec<_>>>()?;
        self.gaussians.write(gpu, &parameters)?;
        let mut planes = self.gaussians.moments.planes_mut().into_iter().zip(&moments);
        planes.try_for_each(|((_, plane), moments)| batches.write(gpu, plane, moments))
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
        let (batches, words) =
            (self.gaussians.parameter_batches(gpu), self.gaussians.parameter_columns());
        let mut before = 0;
        for batch in batches.iter() {
            let planes = batch.of_rows(&self.gaussians.parameters, words)?;
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
        let parameters = self.gaussians.read(gpu)?;
        Ok(Gaussians { count: self.count(), shape: self.shape, parameters })
    }
}
