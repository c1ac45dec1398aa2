//! Adam over the Gaussians' planes and over what else is learned, and the schedules of its learning rates.

mod finite;
mod learnable;
mod schedule;

pub use finite::FiniteCheck;
pub use learnable::Learnable;
pub use schedule::{LearningRates, Schedule};

use std::sync::OnceLock;

use crate::gpu::{Buffer, Gpu, Kernel, Pipeline, Recorder, Threads};
use crate::kernels::{adam, adam_rest};
use crate::splats::batches::Batch;
use crate::splats::halves::Bits;
use crate::{Error, Result};

/// The exponential means of the gradients and of their squares: planes, as the parameters are.
#[derive(Debug)]
pub enum Moments {
    /// Both in 32 bits.
    Single {
        /// Of the gradients.
        first: Buffer<f32>,
        /// Of their squares.
        second: Buffer<f32>,
    },
    /// Both in the bits of one float: the upper half of the first's bits above that of the second's.
    Half(Buffer<f32>),
}

impl Moments {
    /// Zero moments for `len` parameters.
    ///
    /// # Errors
    /// The device is out of memory.
    pub fn zeros(gpu: &Gpu, len: usize) -> Result<Self> {
        Self::of(Bits::Single, |name| gpu.zeros(name, len))
    }

    /// Moments of what makes their planes, by name.
    pub(crate) fn of(
        bits: Bits,
        mut plane: impl FnMut(&'static str) -> Result<Buffer<f32>>,
    ) -> Result<Self> {
        Ok(match bits {
            Bits::Single => {
                Self::Single { first: plane("first_moments")?, second: plane("second_moments")? }
            }
            Bits::Half => Self::Half(plane("moments")?),
        })
    }

    /// Their planes, by name.
    pub(crate) fn planes(&self) -> Vec<(&'static str, &Buffer<f32>)> {
        match self {
            Self::Single { first, second } => {
                vec![("first_moments", first), ("second_moments", second)]
            }
            Self::Half(both) => vec![("moments", both)],
        }
    }

    /// Their planes, by name.
    pub(crate) fn planes_mut(&mut self) -> Vec<(&'static str, &mut Buffer<f32>)> {
        match self {
            Self::Single { first, second } => {
                vec![("first_moments", first), ("second_moments", second)]
            }
            Self::Half(both) => vec![("moments", both)],
        }
    }

    /// Those of a batch of Gaussians.
    ///
    /// # Errors
    /// The planes are shorter.
    pub fn of_batch(&self, batch: &Batch) -> Result<Self> {
        Ok(match self {
            Self::Single { first, second } => {
                Self::Single { first: batch.of_planes(first)?, second: batch.of_planes(second)? }
            }
            Self::Half(both) => Self::Half(batch.of_planes(both)?),
        })
    }

    /// In how many bits they are.
    pub fn bits(&self) -> Bits {
        match self {
            Self::Single { .. } => Bits::Single,
            Self::Half(_) => Bits::Half,
        }
    }

    /// What a kernel binds: either both, or what holds both; of what there is not, nothing.
    fn bound(&self) -> Result<([Buffer<f32>; 2], Buffer<f32>)> {
        let all = |plane: &Buffer<f32>| plane.window(0, plane.len());
        let none = |plane: &Buffer<f32>| plane.window(0, 0);
        Ok(match self {
            Self::Single { first, second } => ([all(first)?, all(second)?], none(first)?),
            Self::Half(both) => ([none(both)?, none(both)?], all(both)?),
        })
    }
}

/// The planes that a step of [`Adam`] works on; each holds `column_count * gaussian_count` floats or more.
#[derive(Debug)]
pub struct AdamBuffers<'a> {
    /// What is optimised.
    pub parameters: &'a mut Buffer<f32>,
    /// dL/d parameters; one that is not finite counts as zero.
    pub gradients: &'a Buffer<f32>,
    /// The moments, updated.
    pub moments: &'a mut Moments,
}

/// Adam with beta 0.9 and 0.999, epsilon 1e-15 (Kingma and Ba 2015; the constants of 3DGS).
#[derive(Debug)]
pub struct Adam {
    gpu: Gpu,
    /// With moments of 32 bits and, once there are any, of 16.
    floats: [OnceLock<Pipeline<adam::Kernel>>; 2],
    /// The same for SH coefficients in halves.
    halves: [OnceLock<Pipeline<adam_rest::Kernel>>; 2],
}

impl Adam {
    /// The kernel on this device; those for halves come when there are some.
    ///
    /// # Errors
    /// The device refuses it.
    pub fn new(gpu: &Gpu) -> Result<Self> {
        let adam =
            Self { gpu: gpu.clone(), floats: Default::default(), halves: Default::default() };
        adam.pipeline(&adam.floats, false, &adam::Constants { half_moments: false })?;
        Ok(adam)
    }

    /// Records step number `step`, from 1, over the first `column_count` columns of `gaussian_count` Gaussians, of which
    /// `feature_count` are features. Nothing changes while the first element of `status`, the sticky word, is not zero.
    ///
    /// # Errors
    /// A buffer is shorter than that, the step is 0, or the device refuses the kernel.
    pub fn record(
        &self,
        pass: &mut Recorder<'_>,
        step: u64,
        rates: &LearningRates,
        [gaussian_count, column_count, feature_count]: [u32; 3],
        AdamBuffers { parameters, gradients, moments }: AdamBuffers<'_>,
        status: &Buffer<u32>,
    ) -> Result<()> {
        let len = gaussian_count as usize * column_count as usize;
        check(step, status, [(&*parameters, len), (gradients, len)], (moments, len))?;
        let half_moments = moments.bits() == Bits::Half;
        let constants = adam::Constants { half_moments };
        let pipeline = self.pipeline(&self.floats, half_moments, &constants)?;
        let ([mut first, mut second], mut both) = moments.bound()?;
        let (uncorrected, second_correction) = corrections(step);
        pass.dispatch(
            pipeline,
            &adam::Params {
                gaussian_count,
                column_count,
                feature_count,
                second_correction,
                step: step as u32,
                rates: rates.0.map(|rate| (rate / uncorrected) as f32),
            },
            adam::Buffers {
                parameters,
                gradients,
                first_moments: &mut first,
                second_moments: &mut second,
                both_moments: &mut both,
                status,
            },
            Threads::Exactly([(len as u32).div_ceil(4), 1, 1]),
        )
    }

    /// The same for SH coefficients in halves, `coefficient_count` of each Gaussian behind `first_column` columns.
    ///
    /// # Errors
    /// As [`Adam::record`].
    pub fn record_halves(
        &self,
        pass: &mut Recorder<'_>,
        step: u64,
        rate: f64,
        [gaussian_count, first_column, coefficient_count]: [u32; 3],
        AdamBuffers { parameters, gradients, moments }: AdamBuffers<'_>,
        status: &Buffer<u32>,
    ) -> Result<()> {
        let len = |own: u32| gaussian_count as usize * (first_column + own) as usize;
        let (words, floats) = (len(coefficient_count.div_ceil(2)), len(coefficient_count));
        check(step, status, [(&*parameters, words), (gradients, floats)], (moments, floats))?;
        let half_moments = moments.bits() == Bits::Half;
        let constants = adam_rest::Constants { half_moments };
        let pipeline = self.pipeline(&self.halves, half_moments, &constants)?;
        let ([mut first, mut second], both) = moments.bound()?;
        let (uncorrected, second_correction) = corrections(step);
        pass.dispatch(
            pipeline,
            &adam_rest::Params {
                gaussian_count,
                first_column,
                coefficient_count,
                rate: (rate / uncorrected) as f32,
                second_correction,
                step: step as u32,
            },
            adam_rest::Buffers {
                parameters: &mut parameters.words(),
                gradients,
                first_moments: &mut first,
                second_moments: &mut second,
                both_moments: &mut both.words(),
                status,
            },
            Threads::Exactly([gaussian_count * coefficient_count.div_ceil(4), 1, 1]),
        )
    }

    fn pipeline<'a, K: Kernel>(
        &self,
        pipelines: &'a [OnceLock<Pipeline<K>>; 2],
        half_moments: bool,
        constants: &K::Constants,
    ) -> Result<&'a Pipeline<K>> {
        let place = &pipelines[usize::from(half_moments)];
        if let Some(pipeline) = place.get() {
            return Ok(pipeline);
        }
        let pipeline = self.gpu.pipeline(constants)?;
        Ok(place.get_or_init(|| pipeline))
    }
}

/// A kernel that runs beyond a buffer writes into its neighbours: refuse before anything is recorded.
fn check(
    step: u64,
    status: &Buffer<u32>,
    planes: [(&Buffer<f32>, usize); 2],
    (moments, len): (&Moments, usize),
) -> Result<()> {
    let moments = moments.planes().into_iter().map(|(_, plane)| (plane, len));
    if let Some((short, needed)) = planes.into_iter().chain(moments).find(|(b, n)| b.len() < *n) {
        let (name, has) = (short.name(), short.len());
        let what = format!("buffer `{name}` holds {has} floats, Adam needs {needed}");
        return Err(Error::Usage(what));
    }
    if step == 0 || status.is_empty() {
        let what = "Adam counts steps from 1 and needs a status word";
        return Err(Error::Usage(what.to_owned()));
    }
    Ok(())
}

/// 1 - b1^t and 1 / sqrt(1 - b2^t), taken in double precision: 1 - 0.999^t loses four digits to cancellation at t = 1.
fn corrections(step: u64) -> (f64, f32) {
    let uncorrected = |beta: f64| 1.0 - beta.powf(step as f64);
    (uncorrected(0.9), (1.0 / uncorrected(0.999).sqrt()) as f32)
}
