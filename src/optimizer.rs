//! Adam over the Gaussians' planes and over what else is learned, and the schedules of its learning rates.

mod finite;
mod learnable;
mod schedule;

pub use finite::FiniteCheck;
pub use learnable::Learnable;
pub use schedule::{LearningRates, Schedule};

use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::adam;
use crate::{Error, Result};

/// The exponential means of the gradients and of their squares: planes, as the parameters are.
#[derive(Debug)]
pub struct Moments {
    /// Of the gradients.
    pub first: Buffer<f32>,
    /// Of their squares.
    pub second: Buffer<f32>,
}

impl Moments {
    /// Zero moments for `len` parameters.
    ///
    /// # Errors
    /// The device is out of memory.
    pub fn zeros(gpu: &Gpu, len: usize) -> Result<Self> {
        Ok(Self {
            first: gpu.zeros("first_moments", len)?,
            second: gpu.zeros("second_moments", len)?,
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
    pipeline: Pipeline<adam::Kernel>,
}

impl Adam {
    /// The kernel on this device.
    ///
    /// # Errors
    /// The device refuses the pipeline.
    pub fn new(gpu: &Gpu) -> Result<Self> {
        Ok(Self { pipeline: gpu.pipeline(&adam::Constants::default())? })
    }

    /// Records step number `step`, from 1, over the first `column_count` columns of `gaussian_count` Gaussians, of which
    /// `feature_count` are features. Nothing changes while the first element of `status`, the sticky word, is not zero.
    ///
    /// # Errors
    /// A buffer is shorter than that, or the step is 0.
    pub fn record(
        &self,
        pass: &mut Recorder<'_>,
        step: u64,
        rates: &LearningRates,
        [gaussian_count, column_count, feature_count]: [u32; 3],
        AdamBuffers { parameters, gradients, moments }: AdamBuffers<'_>,
        status: &Buffer<u32>,
    ) -> Result<()> {
        let Moments { first, second } = moments;
        let len = gaussian_count as usize * column_count as usize;
        if let Some(short) = [&*parameters, gradients, first, second].iter().find(|b| b.len() < len)
        {
            let (name, has) = (short.name(), short.len());
            return Err(Error::Usage(format!(
                "buffer `{name}` holds {has} floats, Adam needs {len}"
            )));
        }
        if step == 0 || status.is_empty() {
            return Err(Error::Usage(
                "Adam counts steps from 1 and needs a status word".to_owned(),
            ));
        }
        pass.dispatch(
            &self.pipeline,
            &params(step, rates, [gaussian_count, column_count, feature_count]),
            adam::Buffers {
                parameters,
                gradients,
                first_moments: first,
                second_moments: second,
                status,
            },
            Threads::Exactly([(len as u32).div_ceil(4), 1, 1]),
        )
    }
}

/// The bias corrections are taken in double precision: 1 - 0.999^t loses four digits to cancellation at t = 1.
fn params(
    step: u64,
    rates: &LearningRates,
    [gaussian_count, column_count, feature_count]: [u32; 3],
) -> adam::Params {
    let uncorrected = |beta: f64| 1.0 - beta.powf(step as f64);
    let rate = |rate: f64| (rate / uncorrected(0.9)) as f32;
    adam::Params {
        gaussian_count,
        column_count,
        feature_count,
        second_correction: (1.0 / uncorrected(0.999).sqrt()) as f32,
        rates: rates.0.map(rate),
    }
}
