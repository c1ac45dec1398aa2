//! Terms on the parameters of the Gaussians: the mean opacity and the mean standard deviation, each pressed down by its weight.
//!
//! L = w_o mean sigmoid(o) + w_s mean exp(s), o the raw opacities, s the logarithms of the three standard deviations: the
//! regularisers of 3DGS-MCMC (Kheradmand et al. 2024). They look at no view, so they are recorded after the render's gradient
//! has become that of the parameters, and add to it.

use serde::{Deserialize, Serialize};

use super::log::{LogSlot, PartialSums};
use super::{LossSpec, Term, TermOn};
use crate::attributes::Attribute;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::parameter_terms;
use crate::{Error, Result};

pub(super) const SPEC: LossSpec =
    LossSpec { terms: &[Term::OPACITY, Term::SCALE], on: TermOn::Parameters };

impl Term {
    /// Mean opacity.
    pub const OPACITY: Self = Self {
        column: "opacity",
        name: "opacity",
        is_likeness: false,
        weight: |config| config.parameters.opacity_weight,
        setting: "loss.opacity_weight",
    };
    /// Mean standard deviation, in units of the frame.
    pub const SCALE: Self = Self {
        column: "scale",
        name: "scale",
        weight: |config| config.parameters.scale_weight,
        setting: "loss.scale_weight",
        ..Self::OPACITY
    };
}

/// What the terms on parameters weigh; 0: they are not there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ParameterWeights {
    /// Of the mean opacity; 3DGS-MCMC has 0.01.
    pub opacity_weight: f64,
    /// Of the mean standard deviation, in units of the frame; 3DGS-MCMC has 0.01.
    pub scale_weight: f64,
}

impl ParameterWeights {
    fn is_on(self) -> bool {
        self.opacity_weight > 0.0 || self.scale_weight > 0.0
    }
}

/// What the terms read of one batch of Gaussians.
#[derive(Clone, Copy, Debug)]
pub struct ParameterInputs<'a> {
    /// How many Gaussians the batch has.
    pub gaussian_count: u32,
    /// How many all batches have: the means are over these.
    pub all_count: u32,
    /// Their planes; the columns of opacities and scales are those of include/gaussian.glsl.
    pub parameters: &'a Buffer<f32>,
}

/// A window begins at a multiple of this many floats, where every device lets a binding begin.
const WINDOW: u32 = 64;

/// Records the terms on parameters that have a weight.
#[derive(Debug)]
pub struct ParameterTerms {
    gpu: Gpu,
    weights: ParameterWeights,
    pipeline: Pipeline<parameter_terms::Kernel>,
    gaussians_per_workgroup: u32,
    /// One a workgroup, of all batches one after the other.
    opacity_partials: Buffer<f32>,
    scale_partials: Buffer<f32>,
}

impl ParameterTerms {
    /// None where no weight is above 0.
    ///
    /// # Errors
    /// The device refuses the pipeline.
    pub fn new(gpu: &Gpu, weights: ParameterWeights) -> Result<Option<Self>> {
        let constants = parameter_terms::Constants::default();
        let new = || {
            Ok(Self {
                gpu: gpu.clone(),
                weights,
                pipeline: gpu.pipeline(&constants)?,
                gaussians_per_workgroup: gpu.properties().subgroup_size
                    * constants.gaussians_per_thread,
                opacity_partials: gpu.uninit("opacity_partials", 0)?,
                scale_partials: gpu.uninit("scale_partials", 0)?,
            })
        };
        weights.is_on().then(new).transpose()
    }

    /// Records the terms of a step: adds to the gradients of every batch, planes as the parameters', and writes the means to the
    /// log.
    ///
    /// # Errors
    /// A buffer is shorter than its batch, the log has no such slot, or the device is out of memory.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        batches: &mut [(ParameterInputs<'_>, &mut Buffer<f32>)],
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        log.check()?;
        let each = self.gaussians_per_workgroup;
        // Batches bind windows of the partial sums; what lies between these counts as 0.
        let room = |count: u32| count.div_ceil(each).next_multiple_of(WINDOW);
        let total: u32 = batches.iter().map(|(inputs, _)| room(inputs.gaussian_count)).sum();
        if self.opacity_partials.len() < total as usize {
            self.opacity_partials = self.gpu.uninit("opacity_partials", total as usize)?;
            self.scale_partials = self.gpu.uninit("scale_partials", total as usize)?;
        }
        pass.fill(&mut self.opacity_partials, 0);
        pass.fill(&mut self.scale_partials, 0);
        let (mut first, mut all) = (0, 1);
        for (inputs, gradients) in batches {
            let &mut ParameterInputs { gaussian_count, all_count, parameters } = inputs;
            let needed = gaussian_count as usize * (Attribute::RawOpacities.column(0) + 1);
            for buffer in [parameters, &**gradients] {
                if buffer.len() < needed {
                    let (name, len) = (buffer.name(), buffer.len());
                    let problem = format!("buffer `{name}` holds {len} floats, not {needed}");
                    return Err(Error::Usage(problem));
                }
            }
            all = all_count.max(1);
            let own = room(gaussian_count) as usize;
            let scale =
                |weight: f64, each: u32| (weight / (f64::from(each) * f64::from(all))) as f32;
            pass.dispatch(
                &self.pipeline,
                &parameter_terms::Params {
                    gaussian_count,
                    opacity_scale: scale(self.weights.opacity_weight, 1),
                    log_scale_scale: scale(self.weights.scale_weight, 3),
                },
                parameter_terms::Buffers {
                    parameters,
                    gradients,
                    opacity_partials: &mut self.opacity_partials.window(first, own)?,
                    scale_partials: &mut self.scale_partials.window(first, own)?,
                },
                Threads::Workgroups([gaussian_count.div_ceil(each), 1, 1]),
            )?;
            first += own;
        }
        let mean = |each: f32| 1.0 / (each * all as f32);
        let sums = |term, partials, scale| PartialSums { term, partials, count: total, scale };
        log.record(
            pass,
            [
                sums(Term::OPACITY, &self.opacity_partials, mean(1.0)),
                sums(Term::SCALE, &self.scale_partials, mean(3.0)),
            ],
        )
    }
}
