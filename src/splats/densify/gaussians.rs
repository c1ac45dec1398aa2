//! Gaussians as they are trained.

use crate::Result;
use crate::gpu::{Buffer, Gpu};
use crate::splats::batches::Batches;
use crate::splats::halves::{Bits, Halves};
use crate::splats::optimizer::Moments;

/// Gaussians on the device with their optimiser state, as planes (include/gaussian.glsl) in [`Batches`].
#[derive(Debug)]
pub struct DeviceGaussians {
    /// The number of Gaussians.
    pub count: u32,
    /// Floats per Gaussian: [`crate::splats::scene::width`].
    pub column_count: u32,
    /// How many of these are features.
    pub feature_count: u32,
    /// In how many bits SH coefficients above degree 0 are.
    pub rest: Bits,
    /// `count * parameter_columns()` floats, and room behind them.
    pub parameters: Buffer<f32>,
    /// `count * column_count` floats each.
    pub moments: Moments,
}

impl DeviceGaussians {
    /// So many with parameters of no value and zero moments, each in so many bits.
    ///
    /// # Errors
    /// The device is out of memory.
    pub fn new(
        gpu: &Gpu,
        count: usize,
        [columns, features]: [usize; 2],
        [rest, moments]: [Bits; 2],
    ) -> Result<Self> {
        let batches = Batches::new(gpu, count, [columns, features]);
        let words = rest.columns([columns, features]);
        Ok(Self {
            count: count as u32,
            column_count: columns as u32,
            feature_count: features as u32,
            rest,
            parameters: batches.with_columns(words).uninit(gpu, "parameters")?,
            moments: Moments::of(moments, |name| batches.zeros(gpu, name))?,
        })
    }

    /// Overwrites the parameters with planes of floats.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn write(&mut self, gpu: &Gpu, floats: &[f32]) -> Result<()> {
        let (batches, halves) = (self.parameter_batches(gpu), self.halves());
        match self.rest {
            Bits::Single => batches.write(gpu, &mut self.parameters, floats),
            Bits::Half => batches.write(gpu, &mut self.parameters, &halves.pack(floats)),
        }
    }

    /// The parameters as planes of floats.
    ///
    /// # Errors
    /// The device was lost.
    pub fn read(&self, gpu: &Gpu) -> Result<Vec<f32>> {
        let words = self.parameter_batches(gpu).read(gpu, &self.parameters)?;
        Ok(match self.rest {
            Bits::Single => words,
            Bits::Half => self.halves().unpack(&words),
        })
    }

    /// How their planes lie in the buffers.
    pub fn batches(&self, gpu: &Gpu) -> Batches {
        let [count, columns, features] =
            [self.count, self.column_count, self.feature_count].map(|n| n as usize);
        Batches::new(gpu, count, [columns, features])
    }

    /// How those of the parameters do.
    pub(crate) fn parameter_batches(&self, gpu: &Gpu) -> Batches {
        self.batches(gpu).with_columns(self.parameter_columns())
    }

    /// Words per Gaussian of the parameters.
    pub(crate) fn parameter_columns(&self) -> usize {
        let [columns, features] = [self.column_count, self.feature_count].map(|n| n as usize);
        self.rest.columns([columns, features])
    }

    fn halves(&self) -> Halves {
        let [count, columns, features] =
            [self.count, self.column_count, self.feature_count].map(|n| n as usize);
        Halves::new(count, [columns, features])
    }
}
