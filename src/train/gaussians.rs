//! The Gaussians in training, on the device, with their moments and gradients.

use nightsplat_models::attributes::{AttributePlane, PlaneCounts, planes};
use nightsplat_models::gaussians::{Gaussians, Shape};

use super::precision::PrecisionConfig;
use crate::Result;
use crate::gpu::{Buffer, Gpu, Recorder};
use crate::loss::{LogSlot, ParameterTerms};
use crate::splats::batches::{Batches, GradientKind};
use crate::splats::densify::{Densifier, DensifyInputs, DensifyReport, Round};
use crate::splats::device::{DeviceGaussians, GaussianSlice, Layout, Upload};
use crate::splats::optimizer::{Adam, AdamBuffers, FiniteCheck, GaussianStep, Moments};

/// Planes of every attribute with their moments and gradients, and the statistics of density control. Buffers may be
/// longer than the Gaussians need.
///
/// SH coefficients of a degree have memory, and passes over it, only once the degree is in use.
#[derive(Debug)]
pub(super) struct TrainedGaussians {
    pub(super) values: DeviceGaussians,
    /// Adam's moments.
    pub(super) moments: Moments,
    /// The configured SH degree.
    sh_degree: u32,
    /// Columns, from the first, that are not trained: there are neither gradients nor moments of them.
    frozen_columns: u32,
    pub(super) gradients: Buffer<f32>,
    /// One value per Gaussian.
    pub(super) grad_norm_sums: Buffer<f32>,
    pub(super) visit_counts: Buffer<u32>,
}

impl TrainedGaussians {
    /// Uploads Gaussians with memory for the SH degree `in_use`, or for their own degree if that is higher.
    pub(super) fn upload(
        gpu: &Gpu,
        gaussians: &Gaussians,
        in_use: u32,
        precision: &PrecisionConfig,
        frozen_columns: u32,
    ) -> Result<Self> {
        let sh_degree = gaussians.shape.sh_degree;
        let gaussians = gaussians.with_sh_degree(in_use.max(gaussians.sh_degree_in_use()));
        let mut gaussians = gaussians.upload_as(gpu, precision.rest)?;
        // They move.
        gaussians.bounds = None;
        let count = gaussians.layout.count;
        let batches = gaussians.layout.batches(gpu).without(frozen_columns);
        Ok(Self {
            sh_degree,
            frozen_columns,
            moments: Moments::new(precision.moments, |name| batches.zeros(gpu, name))?,
            gradients: batches.zeros(gpu, "gradients")?,
            grad_norm_sums: gpu.zeros("grad_norm_sums", count)?,
            visit_counts: gpu.zeros("visit_counts", count)?,
            values: gaussians,
        })
    }

    /// The name of the parameters' tensor in a checkpoint.
    pub(super) const PARAMETERS: &str = "gaussians.parameters";

    /// The SH degree of Gaussians with this number of words of parameters.
    pub(super) fn sh_degree_of_words(&self, words: usize) -> u32 {
        let whole = self.whole_shape();
        let of = |sh_degree| {
            Layout { shape: Shape { sh_degree, ..whole }, ..self.values.layout }.words()
        };
        (0..=whole.sh_degree)
            .find(|&sh_degree| of(sh_degree) == words)
            .unwrap_or(self.shape().sh_degree)
    }

    /// Allocates `count` Gaussians of the same shape.
    pub(super) fn zeros_like(&self, gpu: &Gpu, count: usize, in_use: u32) -> Result<Self> {
        let (rest, moments) = (self.values.layout.sh_rest, self.moments.bits());
        let precision = PrecisionConfig { rest, moments, ..PrecisionConfig::default() };
        let zeros = Gaussians::zeros(count, self.whole_shape());
        Self::upload(gpu, &zeros, in_use, &precision, self.frozen_columns)
    }

    /// The batches of gradients and moments.
    pub(super) fn trained_planes(&self, gpu: &Gpu) -> Batches {
        self.values.layout.batches(gpu).without(self.frozen_columns)
    }

    /// The configured shape of the Gaussians.
    pub(super) fn whole_shape(&self) -> Shape {
        Shape { sh_degree: self.sh_degree, ..self.shape() }
    }

    /// Changes the SH degree; coefficients beyond it are dropped with their moments.
    pub(super) fn set_sh_degree(&mut self, gpu: &Gpu, sh_degree: u32) -> Result<()> {
        let old = self.values.layout;
        let new = Layout { shape: Shape { sh_degree, ..old.shape }, ..old };
        // Grows one buffer after the other, keeping contents and capacity.
        let all = Layout { count: old.capacity, ..new };
        lengthen(gpu, &mut self.values.parameters, all.parameter_batches(gpu))?;
        let trained = all.batches(gpu).without(self.frozen_columns);
        self.planes_mut().try_for_each(|plane| lengthen(gpu, plane, trained))?;
        let parameters = self.values.read(gpu)?;
        let batches = self.trained_planes(gpu);
        let planes = self.planes_mut().map(|plane| batches.read(gpu, &*plane));
        let planes = planes.collect::<Result<Vec<_>>>()?;

        self.values.layout = new;
        let (count, shape, origin) = (old.count, old.shape, self.values.origin);
        let resized = |parameters| {
            Gaussians { count, shape, parameters, origin }.with_sh_degree(sh_degree).parameters
        };
        self.values.write(gpu, &resized(parameters))?;
        let batches = self.trained_planes(gpu);
        let mut pairs = self.planes_mut().zip(planes);
        pairs.try_for_each(|(plane, values)| batches.write(gpu, plane, &resized(values)))
    }

    /// Gradients and moments: planes of floats for every column.
    fn planes_mut(&mut self) -> impl Iterator<Item = &mut Buffer<f32>> {
        let moments = self.moments.planes_mut().into_iter().map(|(_, plane)| plane);
        std::iter::once(&mut self.gradients).chain(moments)
    }

    pub(super) fn shape(&self) -> Shape {
        self.values.layout.shape
    }

    pub(super) fn count(&self) -> usize {
        self.values.layout.count
    }

    /// The number of Gaussians that the buffers can hold.
    pub(super) fn capacity(&self) -> usize {
        self.values.layout.capacity
    }

    /// Records a step of Adam over the columns of the SH degree in use, with gradients of this kind. Nothing changes
    /// while the first element of its status is not zero.
    pub(super) fn update(
        &mut self,
        gpu: &Gpu,
        pass: &mut Recorder<'_>,
        adam: &Adam,
        step: GaussianStep<'_>,
        kind: GradientKind,
    ) -> Result<()> {
        let Self { values, moments, gradients, frozen_columns, .. } = self;
        let layout = values.layout;
        layout.batches(gpu).without(*frozen_columns).iter().try_for_each(|batch| {
            let buffers = AdamBuffers {
                parameters: batch.rows_mut(&mut values.parameters, layout.words())?,
                gradients: batch.planes(&*gradients)?,
                moments: moments.of_batch(&batch)?,
            };
            let layout = Layout { count: batch.count, ..layout };
            if kind == GradientKind::Colors {
                return adam.record_gaussians(pass, step, layout, buffers);
            }
            let planes = layout.floats();
            let columns = if step.sh_degree == 0 { planes.before_rest() } else { planes.columns };
            adam.record_trained(pass, step.adam, PlaneCounts { columns, ..planes }, buffers)
        })
    }

    /// Records the terms on parameters, which add to the gradients.
    pub(super) fn record_terms(
        &mut self,
        pass: &mut Recorder<'_>,
        terms: &mut ParameterTerms,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        terms.record(pass, self.values.slice(), &mut self.gradients, log)
    }

    /// One round of density control, if `keeps` accepts the new parameters ([`Densifier::densify`]); the statistics are
    /// reset.
    pub(super) fn densify(
        &mut self,
        gpu: &Gpu,
        densifier: &mut Densifier,
        round: Round,
        keeps: impl FnMut(GaussianSlice<'_>) -> Result<f64>,
    ) -> Result<DensifyReport> {
        let inputs = DensifyInputs {
            moments: &mut self.moments,
            grad_norm_sums: &mut self.grad_norm_sums,
            visit_counts: &mut self.visit_counts,
            gradients: &mut self.gradients,
        };
        let report = densifier.densify(&mut self.values, inputs, round, keeps)?;
        gpu.run("clear_statistics", |pass| {
            pass.fill(&mut self.grad_norm_sums, 0);
            pass.fill(&mut self.visit_counts, 0);
            Ok(())
        })?;
        Ok(report)
    }

    /// The index of the first parameter that is not finite, in the planes of all Gaussians.
    pub(super) fn first_not_finite(
        &self,
        gpu: &Gpu,
        finite: &mut FiniteCheck,
    ) -> Result<Option<usize>> {
        let layout = self.values.layout;
        let (batches, words) = (layout.parameter_batches(gpu), layout.words());
        let mut before = 0;
        for batch in batches.iter() {
            let planes = batch.rows(&self.values.parameters, words)?;
            if let Some(at) = finite.first(gpu, planes, planes.len())? {
                return Ok(Some(batches.index_of(before + at)));
            }
            before += planes.len();
        }
        Ok(None)
    }

    /// The attribute and the Gaussian at an index of planes with `columns` columns.
    pub(super) fn place_of(&self, index: usize, columns: usize) -> (String, usize) {
        let (count, features) = (self.count().max(1), self.shape().features.width());
        let is_within = |AttributePlane { column, width, .. }: &AttributePlane| {
            (column * count..(column + width) * count).contains(&index)
        };
        match planes(features, columns).into_iter().find(is_within) {
            Some(AttributePlane { attribute, column, width }) => {
                (attribute.spec().name.to_owned(), (index - column * count) / width)
            }
            None => ("parameters".to_owned(), index),
        }
    }

    /// The gradients that the last step wrote, of this kind; zeros where it writes none.
    pub(super) fn download_gradients(&self, gpu: &Gpu, kind: GradientKind) -> Result<Gaussians> {
        let mut parameters = self.trained_planes(gpu).read(gpu, &self.gradients)?;
        let planes = self.values.layout.floats();
        if kind == GradientKind::Colors {
            parameters[planes.gaussians * planes.before_rest()..].fill(0.0);
        }
        let (Layout { count, shape, .. }, origin) = (self.values.layout, self.values.origin);
        Ok(Gaussians { count, shape, parameters, origin })
    }

    pub(super) fn download(&self, gpu: &Gpu) -> Result<Gaussians> {
        self.values.download(gpu)
    }
}

/// Grows a buffer to these batches, keeping its contents.
fn lengthen(gpu: &Gpu, buffer: &mut Buffer<f32>, batches: Batches) -> Result<()> {
    let (len, window) = (batches.floats(), batches.window());
    if buffer.len() < len || !buffer.suits_windows(window) {
        let mut longer = gpu.uninit_in_windows(buffer.name(), len.max(buffer.len()), window)?;
        gpu.write(&mut longer, &gpu.read(&*buffer)?)?;
        *buffer = longer;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::gpu;
    use crate::splats::packed_sh::StorageFormat;
    use nightsplat_models::gaussians::Features;

    #[test]
    fn another_sh_degree_keeps_the_moments_of_the_columns_that_are_trained() {
        let gpu = gpu();
        let given = Gaussians::zeros(7, Shape { sh_degree: 3, features: Features::NONE });
        let mut model =
            TrainedGaussians::upload(&gpu, &given, 1, &PrecisionConfig::default(), 11).unwrap();
        // The last float of a frozen column is in the first vector of four.
        let (frozen, in_vectors) = (7 * 11, 7 * 11 / 4 * 4);
        let columns = [14 + 9, 14 + 24];
        let written: Vec<f32> = (0..7 * columns[0] as u16).map(f32::from).collect();
        let planes = model.trained_planes(&gpu);
        planes.write(&gpu, &mut model.gradients, &written).unwrap();
        assert_eq!(model.gradients.len(), 7 * columns[0] - in_vectors);
        model.set_sh_degree(&gpu, 2).unwrap();
        let lens: Vec<_> = model.planes_mut().map(|plane| plane.len()).collect();
        assert_eq!(lens[0], 7 * columns[1] - in_vectors);
        assert!(lens.iter().all(|len| *len == lens[0]));
        let kept = model.trained_planes(&gpu).read(&gpu, &model.gradients).unwrap();
        assert_eq!(kept[frozen..7 * 14], written[frozen..7 * 14]);
        assert_eq!(kept[7 * 14..][..9], written[7 * 14..][..9]);
        assert_eq!(kept[..in_vectors], [0.0; 76]);
    }

    /// Without the capacity, the next round of density control would allocate again.
    #[test]
    fn another_sh_degree_keeps_the_capacity_and_the_contents_of_the_planes() {
        let gpu = gpu();
        let shape = Shape { sh_degree: 3, features: Features::NONE };
        for rest in [StorageFormat::Single, StorageFormat::Half] {
            let precision =
                PrecisionConfig { rest, moments: StorageFormat::Single, ..Default::default() };
            let mut given = Gaussians::zeros(10, shape);
            // Degree 3 is not in use, so there is no memory for it.
            given.parameters[..140].fill(0.5);
            let mut model = TrainedGaussians::upload(&gpu, &given, 0, &precision, 0).unwrap();
            assert_eq!(model.values.parameters.len(), 140);
            model.set_sh_degree(&gpu, 2).unwrap();
            assert_eq!(model.values.parameters.len(), 10 * model.values.layout.words());
            assert_eq!(model.download(&gpu).unwrap(), given.with_sh_degree(2));

            // As after a round that left 1.5 times the capacity.
            model.values.layout.count = 6;
            model.set_sh_degree(&gpu, 3).unwrap();
            let lens = model.planes_mut().map(|plane| plane.len()).collect::<Vec<_>>();
            assert_eq!((model.capacity(), lens), (10, vec![590; 3]));
        }
    }
}
