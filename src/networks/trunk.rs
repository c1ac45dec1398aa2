//! The trunks of LPIPS: convolutional layers as in torchvision, AlexNet (Krizhevsky 2014) and VGG-16 (Simonyan and
//! Zisserman 2015).

use std::path::Path;

use glam::UVec2;

use super::conv::{Activation, ConvVariant, Layer, Product};
use super::file::TensorFile;
use super::{RGB, float_bytes};
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{conv_strided, max_pool};
use crate::{Error, Result};

/// The network of LPIPS.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Network {
    /// AlexNet, the authors' choice for comparing images.
    #[default]
    Alex,
    /// VGG-16, as reported by 3DGS and many later papers.
    Vgg,
}

/// A convolution with a ReLU.
struct TrunkLayer {
    /// Of its tensors in `lpips`.
    name: &'static str,
    channels: [u32; 2],
    /// Width and height of the kernel.
    window: u32,
    stride: u32,
    padding: u32,
    /// Max pooling before the layer: the side of its window in pixels; its stride is 2.
    pool: Option<u32>,
    /// Whether LPIPS compares its activations.
    is_compared: bool,
}

/// A convolution that keeps the size of its input.
const fn conv(name: &'static str, channels: [u32; 2], window: u32) -> TrunkLayer {
    let (stride, padding) = (1, window / 2);
    TrunkLayer { name, channels, window, stride, padding, pool: None, is_compared: false }
}

impl TrunkLayer {
    const fn pooled(self, window: u32) -> Self {
        Self { pool: Some(window), ..self }
    }

    const fn compared(self) -> Self {
        Self { is_compared: true, ..self }
    }
}

static ALEXNET: [TrunkLayer; 5] = [
    TrunkLayer { stride: 4, padding: 2, ..conv("net.slice1.0", [RGB, 64], 11) }.compared(),
    conv("net.slice2.3", [64, 192], 5).pooled(3).compared(),
    conv("net.slice3.6", [192, 384], 3).pooled(3).compared(),
    conv("net.slice4.8", [384, 256], 3).compared(),
    conv("net.slice5.10", [256, 256], 3).compared(),
];

static VGG16: [TrunkLayer; 13] = [
    conv("net.slice1.0", [RGB, 64], 3),
    conv("net.slice1.2", [64, 64], 3).compared(),
    conv("net.slice2.5", [64, 128], 3).pooled(2),
    conv("net.slice2.7", [128, 128], 3).compared(),
    conv("net.slice3.10", [128, 256], 3).pooled(2),
    conv("net.slice3.12", [256, 256], 3),
    conv("net.slice3.14", [256, 256], 3).compared(),
    conv("net.slice4.17", [256, 512], 3).pooled(2),
    conv("net.slice4.19", [512, 512], 3),
    conv("net.slice4.21", [512, 512], 3).compared(),
    conv("net.slice5.24", [512, 512], 3).pooled(2),
    conv("net.slice5.26", [512, 512], 3),
    conv("net.slice5.28", [512, 512], 3).compared(),
];

/// The stride of a pool in pixels.
const POOL_STRIDE: u32 = 2;

/// The remedy in messages about a file of weights.
const REMEDY: &str = "scripts/lpips-weights.py writes AlexNet's or VGG-16's";

impl Network {
    /// All networks.
    pub const ALL: [Self; 2] = [Self::Alex, Self::Vgg];

    /// Its name in `lpips` and in our files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Alex => "alex",
            Self::Vgg => "vgg",
        }
    }

    /// Its title.
    pub fn title(self) -> &'static str {
        match self {
            Self::Alex => "AlexNet",
            Self::Vgg => "VGG-16",
        }
    }

    fn layers(self) -> &'static [TrunkLayer] {
        match self {
            Self::Alex => &ALEXNET,
            Self::Vgg => &VGG16,
        }
    }

    /// The least width and height for which the last layer has a pixel.
    fn min_size(self) -> u32 {
        match self {
            Self::Alex => 31,
            Self::Vgg => 16,
        }
    }

    /// The number of channels of each compared layer.
    pub(crate) fn compared_channels(self) -> impl Iterator<Item = usize> {
        let compared = self.layers().iter().filter(|layer| layer.is_compared);
        compared.map(|layer| layer.channels[1] as usize)
    }

    /// The tensor that identifies the network: only the position of the last convolution differs.
    fn last_tensor(self) -> String {
        let name = self.layers().last().map_or("", |layer| layer.name);
        format!("{name}.weight")
    }

    /// The network of a file, by its last convolution.
    pub(crate) fn detect(path: &Path, file: &TensorFile<'_>) -> Result<Self> {
        let is_held = |network: &Self| file.tensor(&network.last_tensor()).is_some();
        Self::ALL.into_iter().find(is_held).ok_or_else(|| {
            let wanted = Self::ALL
                .map(|network| format!("`{}` of {}", network.last_tensor(), network.title()));
            let wanted = wanted.join(" nor ");
            Error::input(path, format!("contains no weights of LPIPS, neither {wanted}; {REMEDY}"))
        })
    }
}

/// A network on the device.
#[derive(Debug)]
pub(crate) struct Trunk {
    pub(crate) network: Network,
    /// Of each layer in order: weights (out, in, window, window), then biases (out).
    values: Buffer<f32>,
    strided: Pipeline<conv_strided::Kernel>,
    /// For windows of 3.
    product: Product,
    pool: Pipeline<max_pool::Kernel>,
}

impl Trunk {
    /// Loads the network of a file, whose tensors have the names of `lpips`.
    pub(crate) fn new(
        gpu: &Gpu,
        path: &Path,
        file: &TensorFile<'_>,
        network: Network,
    ) -> Result<Self> {
        let mut values = vec![];
        for TrunkLayer { name, channels: [inputs, outputs], window, .. } in network.layers() {
            let [inputs, outputs, window] = [*inputs, *outputs, *window].map(|n| n as usize);
            let shapes = [("weight", &[outputs, inputs, window, window][..]), ("bias", &[outputs])];
            for (part, shape) in shapes {
                values.extend(published(path, file, &format!("{name}.{part}"), shape)?);
            }
        }
        let variant =
            ConvVariant { activation: Activation::Relu, transposed: false, accumulate: false };
        let narrowest = network.layers().iter().map(|layer| layer.channels[1]).min();
        Ok(Self {
            network,
            values: gpu.buffer(network.name(), &values)?,
            strided: gpu.pipeline(&conv_strided::Constants::default())?,
            product: Product::new(gpu, narrowest.unwrap_or(1), variant)?,
            pool: gpu.pipeline(&max_pool::Constants::default())?,
        })
    }

    pub(crate) fn check(&self, gpu: &Gpu, size: UVec2) -> Result<()> {
        let UVec2 { x: width, y: height } = size;
        let (title, least) = (self.network.title(), self.network.min_size());
        if size.min_element() < least {
            return Err(Error::Usage(format!(
                "LPIPS of {title} needs images of at least {least} pixels per side, not {width}x{height}"
            )));
        }
        let (mut widest, mut size) = (0, size);
        for layer in self.network.layers() {
            let [within, after] = layer.sizes(size);
            widest =
                widest.max(floats(layer.channels[0], within)).max(floats(layer.channels[1], after));
            size = after;
        }
        let (bytes, limit) = (float_bytes(widest), gpu.properties().max_storage_buffer_range);
        if bytes <= limit {
            return Ok(());
        }
        let device = &gpu.properties().name;
        Err(Error::Usage(format!(
            "LPIPS of {title} at {width}x{height} needs {bytes} bytes at once, {device} binds {limit} at most; take \
             another device, weights of AlexNet, or a run on smaller pictures"
        )))
    }

    /// The activations of each compared layer for an image (3, H, W) whose size was [checked](Self::check), (channels,
    /// pixels).
    pub(crate) fn activations(
        &self,
        gpu: &Gpu,
        size: UVec2,
        picture: &[f32],
    ) -> Result<Vec<Vec<f32>>> {
        let (mut source, mut size) = (gpu.buffer("picture", picture)?, size);
        let (mut offset, mut activations) = (0, vec![]);
        for layer in self.network.layers() {
            let TrunkLayer { channels: [inputs, outputs], window, .. } = *layer;
            let [within, after] = layer.sizes(size);
            if let Some(window) = layer.pool {
                let mut pooled = gpu.uninit("pooled", floats(inputs, within))?;
                gpu.run("pool", |pass| {
                    self.pool(pass, window, inputs, [size, within], &source, &mut pooled)
                })?;
                source = pooled;
            }
            let mut target = gpu.uninit("activation", floats(outputs, after))?;
            gpu.run(layer.name, |pass| {
                self.convolve(pass, layer, [within, after], offset, &source, &mut target)
            })?;
            if layer.is_compared {
                activations.push(gpu.read(&target)?);
            }
            (source, size) = (target, after);
            offset += outputs * (inputs * window * window + 1);
        }
        Ok(activations)
    }

    fn pool(
        &self,
        pass: &mut Recorder<'_>,
        window: u32,
        channels: u32,
        [size, target_size]: [UVec2; 2],
        source: &Buffer<f32>,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        pass.dispatch(
            &self.pool,
            &max_pool::Params { size, target_size, channels, window, stride: POOL_STRIDE },
            max_pool::Buffers { source: source.slice(), target: target.slice_mut() },
            Threads::Exactly([channels * target_size.element_product(), 1, 1]),
        )
    }

    fn convolve(
        &self,
        pass: &mut Recorder<'_>,
        layer: &TrunkLayer,
        [size, target_size]: [UVec2; 2],
        offset: u32,
        source: &Buffer<f32>,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        let (values, channels) = (&self.values, layer.channels);
        let TrunkLayer { window, stride, padding, .. } = *layer;
        if window == 3 {
            let layer = Layer { offset, values };
            return self.product.record(pass, size, channels, layer, source, target);
        }
        let [in_channels, out_channels] = channels;
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
            conv_strided::Buffers {
                values: values.slice(),
                source: source.slice(),
                target: target.slice_mut(),
            },
            Threads::Exactly([blocks * target_size.element_product(), 1, 1]),
        )
    }
}

impl TrunkLayer {
    /// Pixels of the convolution's input and output, for an input image.
    fn sizes(&self, size: UVec2) -> [UVec2; 2] {
        let within = self.pool.map_or(size, |window| (size - window) / POOL_STRIDE + 1);
        [within, (within + 2 * self.padding - self.window) / self.stride + 1]
    }
}

/// Values of an image.
fn floats(channels: u32, UVec2 { x, y }: UVec2) -> usize {
    channels as usize * x as usize * y as usize
}

/// A tensor of the published weights.
pub(crate) fn published(
    path: &Path,
    file: &TensorFile<'_>,
    name: &str,
    shape: &[usize],
) -> Result<Vec<f32>> {
    let of_lpips = |problem: String| Error::input(path, format!("{problem}; {REMEDY}"));
    let values = file.floats(name, shape).map_err(of_lpips)?;
    if values.iter().all(|value| value.is_finite()) {
        return Ok(values);
    }
    Err(of_lpips(format!("tensor `{name}` holds values that are not finite")))
}
