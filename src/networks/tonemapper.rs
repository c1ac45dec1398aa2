//! The tonemapper: three convolutions from illumination times denoised image to the dark photograph.

use glam::UVec2;
use nightsplat_core::random::Stream;

use super::conv::{
    AccumulateInto, Activation, Backward, Conv, Layer, Precision, Strips, partial_count,
};
use super::parameters::{ParameterLayout, Parameters};
use super::relu::ReluBackward;
use super::reserved::{Extent, Reserved};
use super::{NetworkVariant, RGB, check_binding};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{product, product_backward};

/// The stream of random numbers that the weights are drawn from.
const STREAM: u64 = 6;

/// Feature maps of both inner layers.
const CHANNELS: u32 = 16;

/// conv 3 to 16, `ReLU`, conv 16 to 16, `ReLU`, conv 16 to 3, no activation; zero padding 1. In the identity variant
/// the input is added to the output.
#[derive(Debug)]
pub struct Tonemapper {
    gpu: Gpu,
    variant: NetworkVariant,
    parameters: Parameters,
    /// The offsets of the layers in the parameters.
    offsets: [u32; 3],
    convs: [Conv; 3],
    product: Pipeline<product::Kernel>,
    product_backward: Pipeline<product_backward::Kernel>,
    relu_backward: ReluBackward,
    reserved: Reserved<TonemapperMemory>,
}

#[derive(Debug)]
struct TonemapperMemory {
    /// (3, H, W)
    product: Buffer<f32>,
    /// Both (16, H, W).
    features: [Buffer<f32>; 2],
    /// (3, H, W)
    output: Buffer<f32>,
    /// Both (16, H, W).
    d_features: [Buffer<f32>; 2],
    /// (3, H, W)
    d_product: Buffer<f32>,
    partials: Buffer<f32>,
}

impl Tonemapper {
    /// Adam's learning rate in LITA-GS.
    pub const LEARNING_RATE: f64 = 1e-4;

    /// Draws the weights; [`Tonemapper::reserve`] allocates for views.
    pub fn new(gpu: &Gpu, variant: NetworkVariant, seed: u64) -> Result<Self> {
        let mut layout = ParameterLayout::new(Stream::new(seed, STREAM));
        let offsets = [
            layout.conv("conv1", RGB, CHANNELS),
            layout.conv("conv2", CHANNELS, CHANNELS),
            layout.last_conv("conv3", CHANNELS, variant),
        ];
        let (relu, none) = (Activation::Relu, Activation::None);
        let [adds_input, adds_output] = match variant {
            NetworkVariant::Identity => [AccumulateInto::InputGradient, AccumulateInto::Output],
            NetworkVariant::Paper => [AccumulateInto::Nothing; 2],
        };
        Ok(Self {
            gpu: gpu.clone(),
            variant,
            parameters: layout.upload(gpu, "tonemapper", Self::LEARNING_RATE, "{}".to_owned())?,
            offsets,
            convs: [
                Conv::new(gpu, [RGB, CHANNELS], relu, adds_input)?,
                Conv::new(gpu, [CHANNELS, CHANNELS], relu, AccumulateInto::Nothing)?,
                Conv::new(gpu, [CHANNELS, RGB], none, adds_output)?,
            ],
            product: gpu.pipeline(&product::Constants::default())?,
            product_backward: gpu.pipeline(&product_backward::Constants::default())?,
            relu_backward: ReluBackward::new(gpu)?,
            reserved: Reserved::new("tonemapper", |extent| TonemapperMemory::new(gpu, extent))?,
        })
    }

    /// The parameters and their gradients.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// [`Tonemapper::parameters`], mutable.
    pub fn parameters_mut(&mut self) -> &mut Parameters {
        &mut self.parameters
    }

    /// The radius of a pixel's receptive field, in pixels.
    pub fn margin(&self) -> u32 {
        self.convs.len() as u32
    }

    /// Whether the device can bind every map of a view of `size`.
    pub fn fits_on(gpu: &Gpu, size: UVec2) -> bool {
        check_maps(gpu, size).is_ok()
    }

    /// Allocates for views up to `size`; it never shrinks.
    pub fn reserve(&mut self, size: UVec2) -> Result<()> {
        check_maps(&self.gpu, size)?;
        self.reserved.grow(extent(size), |extent| TonemapperMemory::new(&self.gpu, extent))
    }

    /// The output of the last forward pass, (3, H, W), not clamped, at the start of a buffer of the reserved length.
    pub fn output(&self) -> &Buffer<f32> {
        &self.reserved.memory.output
    }

    /// Records the forward pass from illumination and denoised image, each (3, H, W), to [`Tonemapper::output`].
    pub fn forward(
        &mut self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        illumination: &Buffer<f32>,
        denoised: &Buffer<f32>,
    ) -> Result<()> {
        let images = [illumination, denoised];
        let value_count = RGB * self.reserved.check_forward(size, extent(size), images)?;
        let TonemapperMemory { product, features: [first, second], output, .. } =
            &mut self.reserved.memory;
        pass.dispatch(
            &self.product,
            &product::Params { value_count },
            product::Buffers {
                illumination: illumination.slice(),
                denoised: denoised.slice(),
                target: product.slice_mut(),
            },
            Threads::Exactly([value_count, 1, 1]),
        )?;
        let ([conv_in, conv, conv_out], values) = (&self.convs, &self.parameters.values);
        let [layer_in, layer, layer_out] = self.offsets.map(|offset| Layer { offset, values });
        conv_in.forward(pass, size, layer_in, product, first)?;
        conv.forward(pass, size, layer, first, second)?;
        if self.variant == NetworkVariant::Identity {
            pass.copy(product, output);
        }
        conv_out.forward(pass, size, layer_out, second, output)?;
        self.reserved.recorded = Some(size);
        Ok(())
    }

    /// Records the backward pass from dL/d output: overwrites the gradients of the parameters, writes `d_illumination`
    /// and adds to `d_denoised`, each (3, H, W). Inputs and parameters must be those of the preceding forward pass.
    #[expect(clippy::too_many_arguments, reason = "three images in, two gradients out")]
    pub fn backward(
        &mut self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        illumination: &Buffer<f32>,
        denoised: &Buffer<f32>,
        d_output: &Buffer<f32>,
        d_illumination: &mut Buffer<f32>,
        d_denoised: &mut Buffer<f32>,
    ) -> Result<()> {
        let images = [illumination, denoised, d_output, d_illumination, d_denoised];
        let pixel_count = self.reserved.check_backward(size, images)?;
        let TonemapperMemory { product, features, d_features, d_product, partials, .. } =
            &mut self.reserved.memory;
        let Parameters { values, gradients, .. } = &mut self.parameters;
        let [conv_in, conv, conv_out] = &self.convs;
        let [layer_in, layer, layer_out] = self.offsets.map(|offset| Layer { offset, values });
        let ([first, second], [d_first, d_second]) = (features, d_features);
        pass.fill(gradients, 0);

        let mut strips = Strips { partials, gradients };
        let images = Backward { source: second, d_target: d_output, d_source: d_second };
        conv_out.backward(pass, size, layer_out, images, &mut strips)?;
        let value_count = CHANNELS * pixel_count;
        self.relu_backward.record(pass, value_count, second, d_second)?;
        let images = Backward { source: first, d_target: d_second, d_source: d_first };
        conv.backward(pass, size, layer, images, &mut strips)?;
        self.relu_backward.record(pass, value_count, first, d_first)?;
        if self.variant == NetworkVariant::Identity {
            pass.copy(d_output, d_product);
        }
        let images = Backward { source: product, d_target: d_first, d_source: d_product };
        conv_in.backward(pass, size, layer_in, images, &mut strips)?;
        let value_count = RGB * pixel_count;
        pass.dispatch(
            &self.product_backward,
            &product_backward::Params { value_count },
            product_backward::Buffers {
                illumination: illumination.slice(),
                denoised: denoised.slice(),
                d_target: d_product.slice(),
                d_illumination: d_illumination.slice_mut(),
                d_denoised: d_denoised.slice_mut(),
            },
            Threads::Exactly([value_count, 1, 1]),
        )
    }
}

fn extent(size: UVec2) -> Extent {
    Extent {
        pixels: size.x as usize * size.y as usize,
        partials: partial_count(size, [CHANNELS, CHANNELS], Precision::Single),
        packed: 0,
    }
}

fn check_maps(gpu: &Gpu, size: UVec2) -> Result<()> {
    let map = CHANNELS as usize * extent(size).pixels;
    check_binding(gpu, "the tonemapper's feature maps", size, map)
}

impl TonemapperMemory {
    fn new(gpu: &Gpu, Extent { pixels, partials, .. }: Extent) -> Result<Self> {
        let map = |name| gpu.uninit(name, CHANNELS as usize * pixels);
        let image = |name| gpu.uninit(name, RGB as usize * pixels);
        Ok(Self {
            product: image("product")?,
            features: [map("features")?, map("features")?],
            output: image("output")?,
            d_features: [map("d_features")?, map("d_features")?],
            d_product: image("d_product")?,
            partials: gpu.uninit("partials", partials)?,
        })
    }
}
