//! The parameters of a network: one flat array on the device, and the table of the tensors in it.

use nightsplat_core::random::Stream;

use super::{NetworkVariant, RGB};
use crate::Result;
use crate::gpu::{Buffer, Gpu};
use crate::splats::optimizer::{AdamBuffers, Learnable, Moments};

/// The location of a tensor in the array, under its name in `PyTorch`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tensor {
    /// For example `0.conv_in.weight`.
    pub name: String,
    /// For the weights of a convolution (out, in, 3, 3).
    pub shape: Vec<usize>,
    /// The index of its first element.
    pub offset: usize,
}

impl Tensor {
    /// The number of elements.
    pub fn element_count(&self) -> usize {
        self.shape.iter().product()
    }
}

/// The parameters of a network, their gradients and Adam's moments.
#[derive(Debug)]
pub struct Parameters {
    /// The network's name in files.
    pub name: &'static str,
    /// Adam's learning rate.
    pub learning_rate: f64,
    /// All tensors, contiguous.
    pub values: Buffer<f32>,
    /// dL/d values of the last backward pass.
    pub gradients: Buffer<f32>,
    moments: Moments,
    tensors: Vec<Tensor>,
    /// The settings that determine the shapes, as JSON.
    settings: String,
}

impl Parameters {
    /// The tensors in the order of `values`.
    pub fn tensors(&self) -> &[Tensor] {
        &self.tensors
    }

    /// The settings that determine the shapes, as JSON.
    pub fn settings(&self) -> &str {
        &self.settings
    }
}

impl Learnable for Parameters {
    fn name(&self) -> &'static str {
        self.name
    }

    fn learning_rate(&self, _: u64) -> f64 {
        self.learning_rate
    }

    fn buffers(&mut self) -> AdamBuffers<'_> {
        let Self { values, gradients, moments, .. } = self;
        AdamBuffers {
            parameters: values.slice_mut(),
            gradients: gradients.slice(),
            moments: moments.slice_mut(),
        }
    }
}

/// Lays out the tensors of a network and draws their initial values.
#[derive(Debug)]
pub(super) struct ParameterLayout {
    random: Stream,
    tensors: Vec<Tensor>,
    values: Vec<f32>,
}

impl ParameterLayout {
    pub(super) fn new(random: Stream) -> Self {
        Self { random, tensors: vec![], values: vec![] }
    }

    /// Weights (out, in, 3, 3), then biases (out), uniform in +-1 / sqrt(9 in): `PyTorch`'s default (Kaiming, a = sqrt
    /// 5).
    pub(super) fn conv(&mut self, name: &str, inputs: u32, outputs: u32) -> u32 {
        let (inputs, outputs) = (inputs as usize, outputs as usize);
        let bound = 1.0 / (9.0 * inputs as f64).sqrt();
        let random = self.random;
        let draw = |at: usize| (bound * (2.0 * random.uniform(at as u64) - 1.0)) as f32;
        let offset = self.tensor(format!("{name}.weight"), vec![outputs, inputs, 3, 3], draw);
        self.tensor(format!("{name}.bias"), vec![outputs], draw);
        offset
    }

    /// The last layer, to RGB: [`ParameterLayout::conv`], or zeros in the identity variant, which still learn.
    pub(super) fn last_conv(&mut self, name: &str, inputs: u32, variant: NetworkVariant) -> u32 {
        if variant == NetworkVariant::Paper {
            return self.conv(name, inputs, RGB);
        }
        let shape = vec![RGB as usize, inputs as usize, 3, 3];
        let offset = self.tensor(format!("{name}.weight"), shape, |_| 0.0);
        self.tensor(format!("{name}.bias"), vec![RGB as usize], |_| 0.0);
        offset
    }

    /// gamma (1), then beta (0).
    pub(super) fn norm(&mut self, name: &str, channels: u32) -> u32 {
        let shape = vec![channels as usize];
        let offset = self.tensor(format!("{name}.weight"), shape.clone(), |_| 1.0);
        self.tensor(format!("{name}.bias"), shape, |_| 0.0);
        offset
    }

    fn tensor(&mut self, name: String, shape: Vec<usize>, value: impl Fn(usize) -> f32) -> u32 {
        let offset = self.values.len();
        let tensor = Tensor { name, shape, offset };
        self.values.extend((offset..offset + tensor.element_count()).map(value));
        self.tensors.push(tensor);
        offset as u32
    }

    pub(super) fn upload(
        self,
        gpu: &Gpu,
        name: &'static str,
        learning_rate: f64,
        settings: String,
    ) -> Result<Parameters> {
        Ok(Parameters {
            name,
            learning_rate,
            values: gpu.buffer("network_values", &self.values)?,
            gradients: gpu.zeros("network_gradients", self.values.len())?,
            moments: Moments::zeros(gpu, self.values.len())?,
            tensors: self.tensors,
            settings,
        })
    }
}
