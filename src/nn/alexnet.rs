//! The convolutions of AlexNet (Krizhevsky 2014, torchvision's), whose activations LPIPS compares pictures by.

use std::path::Path;

use glam::UVec2;

use super::RGB;
use super::conv::{Activation, Form, Product};
use super::file::TensorFile;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{conv_strided, max_pool};
use crate::{Error, Result};

/// A convolution, behind it a ReLU.
struct Layer {
    /// Of its tensors in `PyTorch`.
    name: &'static str,
    channels: [u32; 2],
    /// Taps to a side.
    window: u32,
    stride: u32,
    padding: u32,
    /// The largest of each 3 x 3, every second pixel, goes in.
    is_pooled: bool,
}

const fn layer(name: &'static str, channels: [u32; 2], window: u32, is_pooled: bool) -> Layer {
    Layer { name, channels, window, stride: 1, padding: window / 2, is_pooled }
}

/// How many layers are looked at.
pub(crate) const LAYERS: usize = 5;

const NETWORK: [Layer; LAYERS] = [
    Layer { stride: 4, padding: 2, ..layer("net.slice1.0", [RGB, 64], 11, false) },
    layer("net.slice2.3", [64, 192], 5, true),
    layer("net.slice3.6", [192, 384], 3, true),
    layer("net.slice4.8", [384, 256], 3, false),
    layer("net.slice5.10", [256, 256], 3, false),
];

/// The least width and height that leave the last layer a pixel.
pub(crate) const LEAST_SIZE: u32 = 31;

const POOL: (u32, u32) = (3, 2);

/// The network on the device, with the memory of one picture.
#[derive(Debug)]
pub(crate) struct AlexNet {
    /// Of each layer in turn weights (out, in, window, window), then biases (out).
    values: Buffer<f32>,
    strided: Pipeline<conv_strided::Kernel>,
    /// Of those whose window is 3.
    products: Vec<Product>,
    pool: Pipeline<max_pool::Kernel>,
}

impl AlexNet {
    /// The network of a file, whose tensors have the names of `lpips`'s.
    ///
    /// # Errors
    /// The file lacks a tensor, or has one of another shape or with a value that is not finite; the device is out of memory.
    pub(crate) fn new(gpu: &Gpu, path: &Path, file: &TensorFile<'_>) -> Result<Self> {
        let mut values = vec![];
        for Layer { name, channels: [inputs, outputs], window, .. } in &NETWORK {
            let [inputs, outputs, window] = [*inputs, *outputs, *window].map(|n| n as usize);
            let shapes = [("weight", &[outputs, inputs, window, window][..]), ("bias", &[outputs])];
            for (part, shape) in shapes {
                values.extend(published(path, file, &format!("{name}.{part}"), shape)?);
            }
        }
        let form = Form { activation: Activation::Relu, transposed: false, accumulate: false };
        let small = NETWORK.iter().filter(|layer| layer.window == 3);
        let products = small.map(|layer| Product::new(gpu, layer.channels[1], form));
        Ok(Self {
            values: gpu.buffer("alexnet", &values)?,
            strided: gpu.pipeline(&conv_strided::Constants::default())?,
            products: products.collect::<Result<_>>()?,
            pool: gpu.pipeline(&max_pool::Constants::default())?,
        })
    }

    /// How many channels a layer's activations have.
    pub(crate) fn channels(layer: usize) -> usize {
        NETWORK[layer].channels[1] as usize
    }

    /// What each layer makes of a picture (3, H, W): its activations, (channels, pixels).
    ///
    /// # Errors
    /// The picture is too small, or the device is out of memory or lost.
    pub(crate) fn activations(
        &self,
        gpu: &Gpu,
        size: UVec2,
        picture: &[f32],
    ) -> Result<[Vec<f32>; LAYERS]> {
        if size.min_element() < LEAST_SIZE {
            let UVec2 { x, y } = size;
            return Err(Error::Usage(format!(
                "LPIPS looks at pictures of {LEAST_SIZE} pixels to a side and more, not {x}x{y}"
            )));
        }
        let (mut source, mut size) = (gpu.buffer("picture", picture)?, size);
        let (mut offset, mut products) = (0, self.products.iter());
        let mut activations = std::array::from_fn(|_| vec![]);
        for (layer, kept) in NETWORK.iter().zip(&mut activations) {
            let Layer { channels: [inputs, outputs], window, .. } = *layer;
            let [within, after] = layer.sizes(size);
            let pooled = if layer.is_pooled { inputs * within.element_product() } else { 0 };
            let mut pooled = gpu.uninit("pooled", pooled as usize)?;
            let mut target =
                gpu.uninit("activation", (outputs * after.element_product()) as usize)?;
            let product = if window == 3 { products.next() } else { None };
            gpu.run("alexnet", |pass| {
                let source = if layer.is_pooled {
                    self.pool(pass, inputs, [size, within], &source, &mut pooled)?;
                    &pooled
                } else {
                    &source
                };
                match product {
                    Some(product) => product.record(
                        pass,
                        within,
                        layer.channels,
                        offset,
                        &self.values,
                        source,
                        &mut target,
                    ),
                    None => self.strided(pass, layer, [within, after], offset, source, &mut target),
                }
            })?;
            *kept = gpu.read(&target)?;
            (source, size) = (target, after);
            offset += outputs * (inputs * window * window + 1);
        }
        Ok(activations)
    }

    fn pool(
        &self,
        pass: &mut Recorder<'_>,
        channels: u32,
        [size, target_size]: [UVec2; 2],
        source: &Buffer<f32>,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        let (window, stride) = POOL;
        pass.dispatch(
            &self.pool,
            &max_pool::Params { size, target_size, channels, window, stride },
            max_pool::Buffers { source, target },
            Threads::Exactly([channels * target_size.element_product(), 1, 1]),
        )
    }

    fn strided(
        &self,
        pass: &mut Recorder<'_>,
        layer: &Layer,
        [size, target_size]: [UVec2; 2],
        offset: u32,
        source: &Buffer<f32>,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        let Layer { channels: [in_channels, out_channels], window, stride, padding, .. } = *layer;
        let blocks = out_channels.div_ceil(conv_strided::Constants::default().out_block);
        pass.dispatch(
            &self.strided,
            &conv_strided::Params {
                size,
                target_size,
                in_channels,
                out_channels,
                window,
                stride,
                padding,
                offset,
            },
            conv_strided::Buffers { values: &self.values, source, target },
            Threads::Exactly([blocks * target_size.element_product(), 1, 1]),
        )
    }
}

impl Layer {
    /// Pixels of what is convolved and of what comes out, for a picture that comes in.
    fn sizes(&self, size: UVec2) -> [UVec2; 2] {
        let (window, stride) = POOL;
        let within = if self.is_pooled { (size - window) / stride + 1 } else { size };
        [within, (within + 2 * self.padding - self.window) / self.stride + 1]
    }
}

/// A tensor of the published weights.
///
/// # Errors
/// [`Error::Input`] where the file lacks it, has one of another shape, or one that is not finite.
pub(crate) fn published(
    path: &Path,
    file: &TensorFile<'_>,
    name: &str,
    shape: &[usize],
) -> Result<Vec<f32>> {
    let of_lpips = |problem: String| {
        let remedy = "LPIPS of AlexNet is wanted; docs/guide.md says how to convert it";
        Error::input(path, format!("{problem}; {remedy}"))
    };
    let values = file.floats(name, shape).map_err(of_lpips)?;
    if values.iter().all(|value| value.is_finite()) {
        return Ok(values);
    }
    Err(of_lpips(format!("tensor `{name}` holds values that are not finite")))
}
