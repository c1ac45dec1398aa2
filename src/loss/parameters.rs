//! Terms on the parameters of the Gaussians: mean opacity, mean standard deviation and anisotropy, each times its
//! weight.
//!
//! L = a mean sigmoid(o) + b mean exp(s) + c mean max(max s - min s - ln r, 0), a, b and c the weights, o the raw
//! opacities, s the logarithms of the three standard deviations. The first two are the regularisers of 3DGS-MCMC
//! (Kheradmand et al. 2024). The third is that of `PhysGaussian` (Xie et al. 2024), applied to the logarithm of the
//! ratio, so that its gradient does not grow with the ratio. They do not depend on a view: they are recorded after the
//! backward pass of the render, and add to its gradient.

use nightsplat_core::settings;
use nightsplat_core::settings::Rule;

use super::log::{LogSlot, PartialSums};
use super::{LossSpec, Term, TermOn};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::parameter_terms;
use crate::splats::batches::Batch;
use crate::splats::device::GaussianSlice;

pub(super) const SPEC: LossSpec =
    LossSpec { terms: &[Term::OPACITY, Term::SCALE, Term::ANISOTROPY], on: TermOn::Parameters };

impl Term {
    /// Mean opacity.
    pub const OPACITY: Self =
        Self::distance("opacity", "opacity", |config| config.parameters.opacity_weight);
    /// Mean standard deviation, in units of the frame.
    pub const SCALE: Self =
        Self::distance("scale", "scale", |config| config.parameters.scale_weight);
    /// Mean excess of the logarithm of longest over shortest standard deviation.
    pub const ANISOTROPY: Self =
        Self::distance("anisotropy", "anisotropy", |config| config.parameters.anisotropy_weight);
}

settings! {
"loss."
/// The weights of the terms on parameters; a term of weight 0 is off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ParameterWeights {
    /// Weight of the mean opacity; 3DGS-MCMC has 0.01.
    opacity_weight: f64 = 0.0 => Rule::POSITIVE_OR_0;
    /// Weight of the mean standard deviation, in units of the frame; 3DGS-MCMC has 0.01.
    scale_weight: f64 = 0.0 => Rule::POSITIVE_OR_0;
    /// Weight of the mean excess of ln(longest / shortest standard deviation) over ln(`loss.anisotropy_limit`).
    anisotropy_weight: f64 = 0.0 => Rule::POSITIVE_OR_0;
    /// The largest ratio of longest to shortest standard deviation without a loss.
    anisotropy_limit: f64 = 3.0 => Rule::from_to(1.0, 1e6);
}
}

impl ParameterWeights {
    fn is_on(self) -> bool {
        self.opacity_weight > 0.0 || self.scale_weight > 0.0 || self.anisotropy_weight > 0.0
    }
}

/// A part begins at a multiple of this many floats, which is aligned for bindings on every device.
const PART: usize = 64;

/// Records the terms on parameters that have a weight.
#[derive(Debug)]
pub struct ParameterTerms {
    gpu: Gpu,
    weights: ParameterWeights,
    frozen_columns: u32,
    pipeline: Pipeline<parameter_terms::Kernel>,
    gaussians_per_workgroup: u32,
    /// One per workgroup, of all batches in order.
    opacity_partials: Buffer<f32>,
    scale_partials: Buffer<f32>,
    ratio_partials: Buffer<f32>,
}

impl ParameterTerms {
    /// `None` if no weight is above 0. The first `frozen_columns` columns are not trained.
    pub fn new(gpu: &Gpu, weights: ParameterWeights, frozen_columns: u32) -> Result<Option<Self>> {
        let constants = parameter_terms::Constants { frozen_columns, ..Default::default() };
        let new = || {
            Ok(Self {
                gpu: gpu.clone(),
                weights,
                frozen_columns,
                pipeline: gpu.pipeline(&constants)?,
                gaussians_per_workgroup: gpu.properties().subgroup_size
                    * constants.gaussians_per_thread,
                opacity_partials: gpu.uninit("opacity_partials", 0)?,
                scale_partials: gpu.uninit("scale_partials", 0)?,
                ratio_partials: gpu.uninit("ratio_partials", 0)?,
            })
        };
        weights.is_on().then(new).transpose()
    }

    /// Records the terms of a step: adds to the gradients, planes of the trained columns, and writes the means to the
    /// log.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        GaussianSlice { layout, parameters }: GaussianSlice<'_>,
        gradients: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        log.check()?;
        let batches = layout.batches(&self.gpu).without(self.frozen_columns);
        let each = self.gaussians_per_workgroup;
        let workgroups = |batch: &Batch| batch.gaussian_count().div_ceil(each);
        // Batches bind parts of the partial sums; padding between them counts as 0.
        let padded = |batch: &Batch| (workgroups(batch) as usize).next_multiple_of(PART);
        let total: usize = batches.iter().map(|batch| padded(&batch)).sum();
        let all: u32 = batches.iter().map(|batch| batch.gaussian_count()).sum();
        let Self { opacity_partials, scale_partials, ratio_partials, .. } = self;
        for partials in [opacity_partials, scale_partials, ratio_partials] {
            partials.grow(&self.gpu, total)?;
            pass.fill(partials, 0);
        }
        let scale = |weight: f64, each: f64| (weight / (each * f64::from(all.max(1)))) as f32;
        let mut first = 0;
        for batch in batches.iter() {
            let part = first..first + padded(&batch);
            first = part.end;
            pass.dispatch(
                &self.pipeline,
                &parameter_terms::Params {
                    gaussian_count: batch.gaussian_count(),
                    opacity_scale: scale(self.weights.opacity_weight, 1.0),
                    log_scale_scale: scale(self.weights.scale_weight, 3.0),
                    ratio_scale: scale(self.weights.anisotropy_weight, 1.0),
                    log_ratio: self.weights.anisotropy_limit.ln() as f32,
                },
                parameter_terms::Buffers {
                    parameters: batch.rows(parameters, layout.words())?,
                    gradients: batch.planes_mut(&mut *gradients)?,
                    opacity_partials: self.opacity_partials.slice_mut().range(part.clone())?,
                    scale_partials: self.scale_partials.slice_mut().range(part.clone())?,
                    ratio_partials: self.ratio_partials.slice_mut().range(part)?,
                },
                Threads::Workgroups([workgroups(&batch), 1, 1]),
            )?;
        }
        let mean = |each: f32| 1.0 / (each * all.max(1) as f32);
        let sums =
            |term, partials, scale| PartialSums { term, partials, count: total as u32, scale };
        log.record(
            pass,
            [
                sums(Term::OPACITY, &self.opacity_partials, mean(1.0)),
                sums(Term::SCALE, &self.scale_partials, mean(3.0)),
            ],
        )?;
        let ratios = sums(Term::ANISOTROPY, &self.ratio_partials, mean(1.0));
        log.record(pass, [ratios, PartialSums { count: 0, ..ratios }])
    }
}
