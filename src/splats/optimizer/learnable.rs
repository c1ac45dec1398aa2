//! Learned parameters other than the Gaussians.

use nightsplat_models::attributes::PlaneCounts;

use super::{Adam, AdamBuffers, AdamStep, LearningRates};
use crate::Result;
use crate::gpu::{Buffer, Recorder};

/// Parameters that Adam trains at one learning rate and a checkpoint stores, such as those of a network.
pub trait Learnable {
    /// The prefix of its tensors in a checkpoint: `NAME.parameters`, `NAME.first_moments`, `NAME.second_moments`.
    fn name(&self) -> &'static str;

    /// Adam's learning rate at a step, counted from 1.
    fn learning_rate(&self, step: u64) -> f64;

    /// The parameters, with the gradients of the step and Adam's moments.
    fn buffers(&mut self) -> AdamBuffers<'_>;
}

impl Adam {
    /// Records step number `step`, from 1, of all parameters, at `rate` times its own learning rate; nothing changes
    /// while `status` is nonzero.
    pub fn update(
        &self,
        pass: &mut Recorder<'_>,
        step: u64,
        rate: f64,
        learnable: &mut dyn Learnable,
        status: &Buffer<u32>,
    ) -> Result<()> {
        let rates = LearningRates::uniform(rate * learnable.learning_rate(step));
        let buffers = learnable.buffers();
        // One column of planes.
        let planes = PlaneCounts { gaussians: buffers.parameters.len(), columns: 1, features: 0 };
        self.record(pass, AdamStep { step, rates: &rates, status }, planes, buffers)
    }
}
