//! The terms of LITA-GS beside the pseudo-GT's: what each part of the model is held to.

use glam::UVec2;

use super::networks::Networks;
use super::views::TrainView;
use super::{ModelConfig, TrainConfig, streams};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Recorder};
use crate::kernels::ToneParameters;
use crate::kernels::ssim::RADIUS;
use crate::loss::{
    DenoisingGradients, DenoisingInputs, DenoisingLoss, DenoisingWeights, DepthInputs, DepthLoss,
    DepthSettings, Interior, LogSlot, Loss, LossInputs, LossSettings, StructureInputs,
    StructureLoss, Term,
};
use crate::nn::{Denoiser, Parameters, Tonemapper};
use crate::optimizer::{Adam, AdamBuffers, LearningRates, Moments};
use crate::random::Stream;
use crate::scene::{COLOR_CHANNELS, Feature, Features};
use crate::tone::ToneCurve;
use crate::window::Window;

/// The terms of the parts that are on.
#[derive(Debug)]
pub(super) struct PartTerms {
    features: Features,
    structure: Option<StructureLoss>,
    depth: Option<(DepthLoss, Stream)>,
    networks: Option<NetworkTerms>,
}

/// The networks in training, and the terms that their outputs are held to.
#[derive(Debug)]
struct NetworkTerms {
    networks: Networks,
    /// Side of the random crop in pixels; 0: the whole view.
    crop: u32,
    crops: Stream,
    denoising: DenoisingLoss,
    low: Loss,
    /// The curve that leaves a photograph as it is.
    no_curve: Buffer<ToneParameters>,
    denoiser: Option<Trained>,
    tonemapper: Option<Trained>,
    /// Of the window, (3, h, w) each: inputs, then gradients.
    illumination: Buffer<f32>,
    photograph: Buffer<f32>,
    d_colors: Buffer<f32>,
    d_denoised: Buffer<f32>,
    d_noise: Buffer<f32>,
    d_illumination: Buffer<f32>,
    d_output: Buffer<f32>,
}

/// What Adam keeps of a network.
#[derive(Debug)]
struct Trained {
    moments: Moments,
    rate: f64,
}

impl PartTerms {
    /// Kernels and scratch memory for views of these sizes.
    ///
    /// # Errors
    /// The device is out of memory.
    pub(super) fn new(gpu: &Gpu, config: &TrainConfig, sizes: &[UVec2]) -> Result<Self> {
        let model = &config.model;
        let structure = model.structure.then(|| StructureLoss::new(gpu, model.weights.structure));
        let settings = DepthSettings { weight: model.weights.depth, box_side: model.depth_box };
        let depth = model.depth.then(|| DepthLoss::new(gpu, settings));
        let has_networks = model.denoiser || model.tonemapper;
        let mut terms = Self {
            features: model.features(),
            structure: structure.transpose()?,
            depth: depth
                .transpose()?
                .map(|depth| (depth, Stream::new(config.seed, streams::BOXES))),
            networks: has_networks.then(|| NetworkTerms::new(gpu, config)).transpose()?,
        };
        for &size in sizes {
            terms.reserve(gpu, size)?;
        }
        Ok(terms)
    }

    fn reserve(&mut self, gpu: &Gpu, size: UVec2) -> Result<()> {
        if let Some(structure) = &mut self.structure {
            structure.reserve(size)?;
        }
        if let Some((depth, _)) = &mut self.depth {
            depth.reserve(size)?;
        }
        match &mut self.networks {
            Some(networks) => networks.reserve(gpu, size),
            None => Ok(()),
        }
    }

    /// The networks; none where no part that is on has one.
    pub(super) fn networks(&mut self) -> Option<&mut Networks> {
        self.networks.as_mut().map(|terms| &mut terms.networks)
    }

    /// Records every term of a step: adds to the gradient of R_0 and writes the planes of the features in `d_render`, (channels, H, W).
    pub(super) fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        step: u64,
        view: &TrainView,
        render: &Buffer<f32>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let size = view.size();
        let plane = |feature| self.features.channels_of(feature).unwrap_or_default().start as u32;
        if let Some((term, structure)) = self.structure.as_mut().zip(view.structure.as_ref()) {
            let plane = plane(Feature::Structure);
            let inputs = StructureInputs { size, render, plane, structure };
            term.record(pass, inputs, d_render, log)?;
        }
        if let Some(((term, stream), depth)) = self.depth.as_mut().zip(view.depth.as_ref()) {
            let plane = plane(Feature::Depth);
            let inputs = DepthInputs { size, render, plane, depth, stream: *stream, step };
            term.record(pass, inputs, d_render, log)?;
        }
        match &mut self.networks {
            Some(terms) => terms.record(pass, step, view, self.features, render, d_render, log),
            None => Ok(()),
        }
    }

    /// Records Adam's step of the networks.
    pub(super) fn update(
        &mut self,
        pass: &mut Recorder<'_>,
        step: u64,
        adam: &Adam,
        status: &Buffer<u32>,
    ) -> Result<()> {
        let Some(terms) = &mut self.networks else { return Ok(()) };
        let mut trained = terms.trained();
        trained.try_for_each(|(_, parameters, trained)| {
            trained.update(pass, step, adam, parameters, status)
        })
    }

    /// Every network's name, parameters and moments.
    pub(super) fn trained_networks(
        &mut self,
    ) -> impl Iterator<Item = (&'static str, &mut Parameters, &mut Moments)> {
        let trained = self.networks.iter_mut().flat_map(NetworkTerms::trained);
        trained.map(|(name, parameters, trained)| (name, parameters, &mut trained.moments))
    }
}

impl NetworkTerms {
    fn new(gpu: &Gpu, config: &TrainConfig) -> Result<Self> {
        let ModelConfig { weights, rates, denoiser_crop, .. } = &config.model;
        let seed = Stream::new(config.seed, streams::NETWORKS).bits(0);
        let networks = Networks::new(gpu, &config.model, config.model.features(), seed)?;
        let trained = |parameters: &Parameters, rate| -> Result<Trained> {
            Ok(Trained { moments: Moments::zeros(gpu, parameters.values.len())?, rate })
        };
        let denoiser = networks.denoiser.as_ref().map(Denoiser::parameters);
        let tonemapper = networks.tonemapper.as_ref().map(Tonemapper::parameters);
        let empty = |name| gpu.uninit(name, 0);
        Ok(Self {
            crop: *denoiser_crop,
            crops: Stream::new(config.seed, streams::CROPS),
            denoising: DenoisingLoss::new(
                gpu,
                DenoisingWeights {
                    mse: weights.denoising,
                    total_variation: weights.total_variation,
                },
            )?,
            low: Loss::new(
                gpu,
                LossSettings {
                    tone_curve: ToneCurve::None.constant(),
                    ssim_weight: weights.low_ssim,
                    terms: [Term::LowL1, Term::LowSsim],
                },
            )?,
            no_curve: gpu.buffer(
                "no_curve",
                &[ToneParameters { white: 1.0, gain: 1.0, ..ToneParameters::default() }],
            )?,
            denoiser: denoiser.map(|p| trained(p, rates.denoiser)).transpose()?,
            tonemapper: tonemapper.map(|p| trained(p, rates.tonemapper)).transpose()?,
            illumination: empty("window_illumination")?,
            photograph: empty("window_photograph")?,
            d_colors: empty("d_window_colors")?,
            d_denoised: empty("d_window_denoised")?,
            d_noise: empty("d_window_noise")?,
            d_illumination: empty("d_window_illumination")?,
            d_output: empty("d_window_output")?,
            networks,
        })
    }

    /// Every network that there is, with its name.
    fn trained(&mut self) -> impl Iterator<Item = (&'static str, &mut Parameters, &mut Trained)> {
        let Networks { denoiser, tonemapper, .. } = &mut self.networks;
        let denoiser = denoiser.as_mut().map(Denoiser::parameters_mut).zip(self.denoiser.as_mut());
        let tonemapper =
            tonemapper.as_mut().map(Tonemapper::parameters_mut).zip(self.tonemapper.as_mut());
        let denoiser = denoiser.map(|(parameters, trained)| ("denoiser", parameters, trained));
        let tonemapper =
            tonemapper.map(|(parameters, trained)| ("tonemapper", parameters, trained));
        denoiser.into_iter().chain(tonemapper)
    }

    /// Memory for the windows of views of `size`.
    fn reserve(&mut self, gpu: &Gpu, size: UVec2) -> Result<()> {
        let size = match self.crop {
            0 => size,
            crop => size.min(UVec2::splat(crop.saturating_add(2 * self.margin()))),
        };
        self.networks.reserve(size)?;
        self.denoising.reserve(size)?;
        self.low.reserve(size)?;
        let values = COLOR_CHANNELS * size.x as usize * size.y as usize;
        for buffer in [
            &mut self.illumination,
            &mut self.photograph,
            &mut self.d_colors,
            &mut self.d_denoised,
            &mut self.d_noise,
            &mut self.d_illumination,
            &mut self.d_output,
        ] {
            if buffer.len() < values {
                let name = buffer.name().to_owned();
                *buffer = gpu.uninit(&name, values)?;
            }
        }
        Ok(())
    }

    /// How far the terms of a pixel look, in pixels.
    fn margin(&self) -> u32 {
        let denoiser = self.networks.denoiser.as_ref().map_or(0, Denoiser::margin);
        let tonemapper = self.networks.tonemapper.as_ref();
        denoiser + tonemapper.map_or(0, |tonemapper| tonemapper.margin() + RADIUS as u32)
    }

    #[expect(
        clippy::too_many_arguments,
        reason = "a step's view, its render, its gradient, its log"
    )]
    fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        step: u64,
        view: &TrainView,
        features: Features,
        render: &Buffer<f32>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let size = view.size();
        let window = match self.crop {
            0 => Window::whole(size),
            crop => Window::random(size, crop, self.margin(), &self.crops, step),
        };
        let interior = Interior { origin: window.crop_origin, size: window.crop_size };
        self.networks.denoise(pass, render, size, &window)?;
        if self.networks.denoiser.is_some() {
            let denoised = self.networks.denoised();
            self.denoising.record(
                pass,
                DenoisingInputs {
                    size: window.size,
                    interior,
                    denoised,
                    render: &self.networks.colors,
                },
                DenoisingGradients {
                    d_denoised: &mut self.d_denoised,
                    d_render: &mut self.d_colors,
                },
                log,
            )?;
        } else {
            pass.fill(&mut self.d_colors, 0);
        }
        if let Some(planes) = features.channels_of(Feature::Illumination) {
            let windows = &self.networks.windows;
            windows.gather(pass, render, size, planes.clone(), &window, &mut self.illumination)?;
            let photograph = &mut self.photograph;
            windows.gather(pass, &view.image, size, 0..COLOR_CHANNELS, &window, photograph)?;
            self.record_low(pass, &window, interior, log)?;
            let windows = &self.networks.windows;
            windows.scatter(pass, &self.d_illumination, &window, planes, size, d_render)?;
        }
        let Networks { denoiser, windows, colors, noise, .. } = &mut self.networks;
        if let Some((denoiser, planes)) =
            denoiser.as_mut().zip(features.channels_of(Feature::Noise))
        {
            denoiser.backward(
                pass,
                window.size,
                noise,
                colors,
                &self.d_denoised,
                &mut self.d_noise,
                &mut self.d_colors,
            )?;
            windows.scatter(pass, &self.d_noise, &window, planes, size, d_render)?;
        }
        windows.scatter(pass, &self.d_colors, &window, 0..COLOR_CHANNELS, size, d_render)
    }

    /// The dark photograph from illumination and R_K, and back to both.
    fn record_low(
        &mut self,
        pass: &mut Recorder<'_>,
        window: &Window,
        interior: Interior,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let size = window.size;
        let Networks { denoiser, tonemapper, colors, .. } = &mut self.networks;
        let Some(tonemapper) = tonemapper else { return Ok(()) };
        let (denoised, d_denoised) = match denoiser.as_ref() {
            Some(denoiser) => (denoiser.denoised(), &mut self.d_denoised),
            None => (&*colors, &mut self.d_colors),
        };
        tonemapper.forward(pass, size, &self.illumination, denoised)?;
        self.low.record(
            pass,
            LossInputs {
                size,
                interior,
                render: tonemapper.output(),
                low: &self.photograph,
                tone: &self.no_curve,
            },
            &mut self.d_output,
            log,
        )?;
        tonemapper.backward(
            pass,
            size,
            &self.illumination,
            denoised,
            &self.d_output,
            &mut self.d_illumination,
            d_denoised,
        )
    }
}

impl Trained {
    /// A network's parameters are one column of Adam's planes.
    fn update(
        &mut self,
        pass: &mut Recorder<'_>,
        step: u64,
        adam: &Adam,
        parameters: &mut Parameters,
        status: &Buffer<u32>,
    ) -> Result<()> {
        let rates = LearningRates::uniform(self.rate);
        let len = parameters.values.len() as u32;
        let Parameters { values, gradients, .. } = parameters;
        adam.record(
            pass,
            step,
            &rates,
            [len, 1, 0],
            AdamBuffers { parameters: values, gradients, moments: &mut self.moments, status },
        )
    }
}
