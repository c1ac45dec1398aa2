//! The denoiser: stages that each estimate the remaining noise and subtract it from the render.
//!
//! ```text
//! I_0 = noise map, I_k = R_k for k >= 1; R_0 = render
//! f = relu(conv_in(I_k)); `repeats` times: f = f + relu(norm(conv(f)))     one conv and one norm for all repeats
//! R_{k+1} = clamp(R_0 - (I_k + sigmoid(conv_out(f))), 0, 1)
//! ```
//!
//! This is the paper's variant. In the identity variant `I_0 = R_0` and `R_{k+1} = I_k - conv_out(f)`, with the last
//! layer zero at first: R_K starts as the render, and no gradient vanishes in a sigmoid or a clamp.
//!
//! Activations are kept for one stage at a time, or for every stage if [`Denoiser::keep_activations`] finds memory;
//! otherwise the backward pass recomputes those of the earlier stages from their inputs `R_k`, to the same bits.

mod inner;
mod memory;

use glam::UVec2;
use nightsplat_core::random::Stream;
use nightsplat_core::settings;
use nightsplat_core::settings::Rule;

use self::inner::{Inner, InnerStage};
use self::memory::{Activations, DenoiserMemory, EarlierStages, StageGradients};
use super::conv::{AccumulateInto, Activation, Backward, Conv, Layer, Precision, Strips};
use super::half::Direction;
use super::parameters::{ParameterLayout, Parameters};
use super::relu::ReluBackward;
use super::reserved::Reserved;
use super::{NetworkVariant, RGB};
use crate::gpu::{Buffer, Gpu, Pipeline, Properties, Recorder, Threads};
use crate::kernels::{residual, residual_backward};
use crate::{Error, Result};

/// The stream of random numbers that the weights are drawn from.
const STREAM: u64 = 5;

settings! {
"model.network."
/// The size of a denoiser, and its initialisation. By default it is the smallest that is worth its time on noisy
/// photographs (docs/measurements.md).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DenoiserSettings {
    /// Stages of the denoiser, each with its own weights.
    stages: u32 = 1 => Rule::Whole(1, 16), "--denoiser-stages N";
    /// Inner convolutions per stage of the denoiser.
    repeats: u32 = 2 => Rule::Whole(1, 64), "--denoiser-repeats N";
    /// Channels of the denoiser.
    channels: u32 = 8 => Rule::Whole(1, 512), "--denoiser-channels N";
    /// Precision of the denoiser: single, or half, which requires 16-bit cooperative matrices.
    precision: Precision = Precision::Single => Rule::OneOf(&["single", "half"]), "--denoiser-precision P";
    /// Variant of the networks, including the tonemapper: identity, which starts as the identity and learns a residual,
    /// or paper.
    variant: NetworkVariant = NetworkVariant::Identity => Rule::OneOf(&["identity", "paper"]);
}
}

impl DenoiserSettings {
    /// The settings of LITA-GS.
    #[doc(hidden)]
    pub fn paper() -> Self {
        Self {
            stages: 3,
            repeats: 6,
            channels: 64,
            precision: Precision::Single,
            variant: NetworkVariant::Paper,
        }
    }

    pub(crate) fn check(&self) -> Result<()> {
        self.check_rows()
    }

    /// The precision that the device supports.
    fn held_on(self, gpu: &Gpu) -> Self {
        Self { precision: self.precision.on(gpu), ..self }
    }

    fn channels(self) -> usize {
        self.channels as usize
    }
}

/// The denoiser, its parameters and the memory of one view.
#[derive(Debug)]
pub struct Denoiser {
    gpu: Gpu,
    settings: DenoiserSettings,
    /// The settings with the precision that the device supports.
    held: DenoiserSettings,
    parameters: Parameters,
    stages: Vec<DenoiserStage>,
    kernels: DenoiserKernels,
    reserved: Reserved<DenoiserMemory>,
    earlier: EarlierStages,
}

/// The offsets of a stage's layers in the parameters.
#[derive(Clone, Copy, Debug)]
struct DenoiserStage {
    number: usize,
    conv_in: u32,
    conv: u32,
    norm: u32,
    conv_out: u32,
}

#[derive(Debug)]
struct DenoiserKernels {
    channels: u32,
    conv_in: Conv,
    inner: Inner,
    conv_out: Conv,
    relu_backward: ReluBackward,
    residual: Pipeline<residual::Kernel>,
    residual_backward: Pipeline<residual_backward::Kernel>,
}

impl Denoiser {
    /// Adam's learning rate in LITA-GS.
    pub const LEARNING_RATE: f64 = 5e-5;

    /// Draws the weights; [`Denoiser::reserve`] allocates for views.
    pub fn new(gpu: &Gpu, settings: DenoiserSettings, seed: u64) -> Result<Self> {
        settings.check()?;
        let mut layout = ParameterLayout::new(Stream::new(seed, STREAM));
        let channels = settings.channels;
        let stage = |k| DenoiserStage {
            number: k as usize,
            conv_in: layout.conv(&format!("{k}.conv_in"), RGB, channels),
            conv: layout.conv(&format!("{k}.conv"), channels, channels),
            norm: layout.norm(&format!("{k}.norm"), channels),
            conv_out: layout.last_conv(&format!("{k}.conv_out"), channels, settings.variant),
        };
        let stages = (0..settings.stages).map(stage).collect();
        let held = settings.held_on(gpu);
        Ok(Self {
            gpu: gpu.clone(),
            settings,
            held,
            parameters: layout.upload(
                gpu,
                "denoiser",
                Self::LEARNING_RATE,
                serde_json::json!(settings).to_string(),
            )?,
            stages,
            kernels: DenoiserKernels::new(gpu, settings)?,
            reserved: Reserved::new("denoiser", |extent| DenoiserMemory::new(gpu, held, extent))?,
            earlier: EarlierStages::default(),
        })
    }

    /// Its settings.
    pub fn settings(&self) -> DenoiserSettings {
        self.settings
    }

    /// The parameters of all stages and their gradients.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// [`Denoiser::parameters`], mutable.
    pub fn parameters_mut(&mut self) -> &mut Parameters {
        &mut self.parameters
    }

    /// Zeroes the last layer of every stage: in the identity variant the output is the input.
    pub fn become_identity(&mut self) -> Result<()> {
        let mut values = self.gpu.read(&self.parameters.values)?;
        for tensor in self.parameters.tensors().iter().filter(|of| of.name.contains("conv_out")) {
            values[tensor.offset..][..tensor.element_count()].fill(0.0);
        }
        self.gpu.write(&mut self.parameters.values, &values)
    }

    /// The radius of a pixel's receptive field, in pixels, excluding the norms, which read the whole view.
    pub fn margin(&self) -> u32 {
        self.settings.stages * (self.settings.repeats + 2)
    }

    /// The memory of [`Denoiser::reserve`] for a view.
    pub fn bytes(settings: DenoiserSettings, size: UVec2) -> u64 {
        memory::bytes(settings, memory::extent(settings, size))
    }

    /// The additional memory of [`Denoiser::keep_activations`] for a view.
    pub fn kept_bytes(settings: DenoiserSettings, size: UVec2) -> u64 {
        EarlierStages::bytes(settings, memory::extent(settings, size))
    }

    /// Whether the device can bind every map of a view of `size`.
    pub fn fits_on(gpu: &Gpu, settings: DenoiserSettings, size: UVec2) -> bool {
        let held = settings.held_on(gpu);
        memory::check(gpu, held, size).is_ok()
    }

    /// Allocates for views up to `size`; it never shrinks.
    pub fn reserve(&mut self, size: UVec2) -> Result<()> {
        let (gpu, held) = (&self.gpu, self.held);
        memory::check(gpu, held, size)?;
        let allocate = |extent| DenoiserMemory::new(gpu, held, extent);
        self.reserved.grow(memory::extent(held, size), allocate)
    }

    /// Keeps the activations of every stage in views up to `size` from now on, if that takes at most `most` bytes and
    /// the device has them; returns whether it does. Results are bit-identical either way.
    pub fn keep_activations(&mut self, size: UVec2, most: u64) -> Result<bool> {
        let (settings, needed) = (self.held, memory::extent(self.held, size));
        if needed.fits(self.earlier.extent()) {
            return Ok(true);
        }
        let extent = needed.max(self.earlier.extent());
        if EarlierStages::bytes(settings, extent) > most {
            return Ok(false);
        }
        (self.reserved.recorded, self.earlier) = (None, EarlierStages::default());
        match EarlierStages::new(&self.gpu, settings, extent) {
            Ok(earlier) => self.earlier = earlier,
            Err(Error::OutOfMemory { .. } | Error::BufferTooLarge { .. }) => return Ok(false),
            Err(other) => return Err(other),
        }
        Ok(true)
    }

    /// `R_K` of the last forward pass, (3, H, W), at the start of a buffer of the reserved length.
    pub fn denoised(&self) -> &Buffer<f32> {
        let denoised = &self.reserved.memory.denoised;
        &denoised[denoised.len() - 1]
    }

    /// Records the forward pass from `I_0`, the noise map or in the identity variant the render, and the render, each
    /// (3, H, W), to [`Denoiser::denoised`].
    pub fn forward(
        &mut self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        input: &Buffer<f32>,
        render: &Buffer<f32>,
    ) -> Result<()> {
        let extent = memory::extent(self.held, size);
        let value_count = RGB * self.reserved.check_forward(size, extent, [input, render])?;
        let Self { kernels, parameters, earlier, .. } = self;
        let DenoiserMemory { activations: shared, denoised, .. } = &mut self.reserved.memory;
        for (k, stage) in self.stages.iter().enumerate() {
            let (before, from_here) = denoised.split_at_mut(k);
            let stage_input = before.last().unwrap_or(input);
            let activations = earlier.activations(k, extent, shared);
            kernels.inner.prepare(pass, Direction::Forward, stage.inner(&parameters.values))?;
            let values = &parameters.values;
            kernels.stage_forward(pass, size, stage, values, stage_input, activations)?;
            pass.dispatch(
                &kernels.residual,
                &residual::Params { value_count },
                residual::Buffers {
                    render: render.slice(),
                    stage_input: stage_input.slice(),
                    update: activations.update.slice(),
                    denoised: from_here[0].slice_mut(),
                },
                Threads::Exactly([value_count, 1, 1]),
            )?;
        }
        self.reserved.recorded = Some(size);
        Ok(())
    }

    /// Records the backward pass from `dL/dR_K`: overwrites the gradients of the parameters, writes `d_input` and adds
    /// to `d_render`, each (3, H, W), the gradient of the render other than through `I_0`: zero in the identity
    /// variant. Inputs and parameters must be those of the preceding forward pass.
    #[expect(clippy::too_many_arguments, reason = "three images in, two gradients out")]
    pub fn backward(
        &mut self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        input: &Buffer<f32>,
        render: &Buffer<f32>,
        d_denoised: &Buffer<f32>,
        d_input: &mut Buffer<f32>,
        d_render: &mut Buffer<f32>,
    ) -> Result<()> {
        let images = [input, render, d_denoised, d_input, d_render];
        let value_count = RGB * self.reserved.check_backward(size, images)?;
        let Self { kernels, earlier, parameters, stages, held, .. } = self;
        let (memory, extent) = (&mut self.reserved.memory, memory::extent(*held, size));
        let are_kept = extent.fits(earlier.extent());
        pass.fill(&mut parameters.gradients, 0);
        for stage in stages.iter() {
            kernels.inner.prepare(pass, Direction::Backward, stage.inner(&parameters.values))?;
        }
        let last = stages.len() - 1;
        for (k, stage) in stages.iter().enumerate().rev() {
            let stage_input = if k == 0 { input } else { &memory.denoised[k - 1] };
            let activations = earlier.activations(k, extent, &mut memory.activations);
            if k < last && !are_kept {
                let values = &parameters.values;
                kernels.stage_forward(pass, size, stage, values, stage_input, activations)?;
            }
            // Two images alternate, so that a stage never reads what it writes.
            let [even, odd] = &mut memory.d_denoised;
            let (written, read) = if k % 2 == 0 { (even, odd) } else { (odd, even) };
            let d_output = if k == last { d_denoised } else { &*read };
            let d_stage_input = if k == 0 { &mut *d_input } else { written };
            pass.dispatch(
                &kernels.residual_backward,
                &residual_backward::Params { value_count },
                residual_backward::Buffers {
                    render: render.slice(),
                    stage_input: stage_input.slice(),
                    update: activations.update.slice(),
                    d_denoised: d_output.slice(),
                    d_update: memory.d_update.slice_mut(),
                    d_stage_input: d_stage_input.slice_mut(),
                    d_render: d_render.slice_mut(),
                },
                Threads::Exactly([value_count, 1, 1]),
            )?;
            let maps = Maps {
                activations,
                gradients: &mut memory.gradients,
                partials: &mut memory.partials,
            };
            let ends = StageMaps { stage_input, d_update: &memory.d_update, d_stage_input };
            kernels.stage_backward(pass, size, stage, parameters, maps, ends)?;
        }
        Ok(())
    }
}

/// The images that the backward pass of a stage reads and overwrites.
struct Maps<'a> {
    activations: &'a mut Activations,
    gradients: &'a mut StageGradients,
    partials: &'a mut Buffer<f32>,
}

/// The images at both ends of a stage's network.
struct StageMaps<'a> {
    stage_input: &'a Buffer<f32>,
    d_update: &'a Buffer<f32>,
    /// Added to.
    d_stage_input: &'a mut Buffer<f32>,
}

impl DenoiserKernels {
    fn new(gpu: &Gpu, settings: DenoiserSettings) -> Result<Self> {
        let DenoiserSettings { channels, precision, variant, .. } = settings;
        let Properties { name, cooperative_matrix, .. } = gpu.properties();
        if precision == Precision::Half && cooperative_matrix.is_none() {
            tracing::warn!("{name} offers no 16-bit matrices: the denoiser is in single precision");
        }
        let adds = AccumulateInto::InputGradient;
        let identity = variant == NetworkVariant::Identity;
        let activation = if identity { Activation::None } else { Activation::Sigmoid };
        Ok(Self {
            channels,
            conv_in: Conv::new(gpu, [RGB, channels], Activation::Relu, adds)?,
            inner: Inner::new(gpu, channels, settings.stages, precision)?,
            conv_out: Conv::new(gpu, [channels, RGB], activation, AccumulateInto::Nothing)?,
            relu_backward: ReluBackward::new(gpu)?,
            residual: gpu.pipeline(&residual::Constants { identity })?,
            residual_backward: gpu.pipeline(&residual_backward::Constants { identity })?,
        })
    }

    /// The activations of a stage.
    fn stage_forward(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        stage: &DenoiserStage,
        values: &Buffer<f32>,
        input: &Buffer<f32>,
        activations: &mut Activations,
    ) -> Result<()> {
        let first = &mut activations.features[0];
        self.conv_in.forward(pass, size, Layer { offset: stage.conv_in, values }, input, first)?;
        self.inner.forward(pass, size, stage.inner(values), activations)?;
        let Activations { features, update, .. } = activations;
        let last = &features[features.len() - 1];
        self.conv_out.forward(pass, size, Layer { offset: stage.conv_out, values }, last, update)
    }

    /// From the gradient of the last layer's sum to that of the stage's input; adds those of the stage's parameters.
    fn stage_backward(
        &self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        stage: &DenoiserStage,
        parameters: &mut Parameters,
        maps: Maps<'_>,
        ends: StageMaps<'_>,
    ) -> Result<()> {
        let Parameters { values, gradients, .. } = parameters;
        let Maps { activations, gradients: of_maps, partials } = maps;
        let mut strips = Strips { partials, gradients };
        let features = &activations.features;
        let images = Backward {
            source: &features[features.len() - 1],
            d_target: ends.d_update,
            d_source: &mut of_maps.features,
        };
        let layer = Layer { offset: stage.conv_out, values };
        self.conv_out.backward(pass, size, layer, images, &mut strips)?;
        let inner = stage.inner(values);
        self.inner.backward(pass, size, inner, activations, of_maps, &mut strips)?;
        let value_count = self.channels * size.element_product();
        let d_features = &mut of_maps.features;
        self.relu_backward.record(pass, value_count, &activations.features[0], d_features)?;
        let StageMaps { stage_input: source, d_stage_input: d_source, .. } = ends;
        let images = Backward { source, d_target: &*d_features, d_source };
        let layer = Layer { offset: stage.conv_in, values };
        self.conv_in.backward(pass, size, layer, images, &mut strips)
    }
}

impl DenoiserStage {
    /// The repeated layers.
    fn inner(self, values: &Buffer<f32>) -> InnerStage<'_> {
        InnerStage { number: self.number, conv: self.conv, norm: self.norm, values }
    }
}
