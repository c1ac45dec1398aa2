//! What is learned beside the Gaussians.

use super::{Adam, AdamBuffers, LearningRates, Moments};
use crate::Result;
use crate::gpu::{Buffer, Recorder};

/// Numbers that Adam trains at one rate and that a checkpoint keeps, such as the parameters of a network.
pub trait Learnable {
    /// What its tensors are called in a checkpoint: `NAME.parameters`, `NAME.first_moments`, `NAME.second_moments`.
    fn name(&self) -> &'static str;

    /// Adam's learning rate.
    fn learning_rate(&self) -> f64;

    /// What is trained.
    fn arrays(&mut self) -> Arrays<'_>;
}

/// The numbers of a [`Learnable`] and what belongs to each.
#[derive(Debug)]
pub struct Arrays<'a> {
    /// What is learned.
    pub values: &'a mut Buffer<f32>,
    /// dL/d values of the step.
    pub gradients: &'a Buffer<f32>,
    /// What Adam keeps.
    pub moments: &'a mut Moments,
}

impl Adam {
    /// Records step number `step`, from 1, of all values; nothing changes while `status` is set.
    ///
    /// # Errors
    /// As [`Adam::record`].
    pub fn update(
        &self,
        pass: &mut Recorder<'_>,
        step: u64,
        learnable: &mut dyn Learnable,
        status: &Buffer<u32>,
    ) -> Result<()> {
        let rates = LearningRates::uniform(learnable.learning_rate());
        let Arrays { values, gradients, moments } = learnable.arrays();
        // One column of planes.
        let shape = [values.len() as u32, 1, 0];
        self.record(
            pass,
            step,
            &rates,
            shape,
            AdamBuffers { parameters: values, gradients, moments, status },
        )
    }
}
