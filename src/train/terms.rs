//! The networks in a training step: windows of the render, forward, what the outputs are held to, backward.

use glam::UVec2;

use super::networks::Networks;
use super::{ModelConfig, TrainConfig, streams};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Recorder};
use crate::kernels::ToneParameters;
use crate::kernels::ssim::RADIUS;
use crate::loss::{
    DenoisingGradients, DenoisingInputs, DenoisingLoss, DenoisingWeights, Interior, LogSlot, Loss,
    LossInputs, LossSettings, Term, TermInputs,
};
use crate::nn::Denoiser;
use crate::random::Stream;
use crate::scene::{COLOR_CHANNELS, Feature};
use crate::tone::ToneCurve;
use crate::window::Window;

/// The networks in training, and the terms that their outputs are held to.
#[derive(Debug)]
pub(super) struct NetworkTerms {
    pub(super) networks: Networks,
    /// Side of the random crop in pixels; 0: the whole view.
    crop: u32,
    crops: Stream,
    denoising: DenoisingLoss,
    low: Loss,
    /// The curve that leaves a photograph as it is.
    no_curve: Buffer<ToneParameters>,
    /// Of the window, (3, h, w) each: inputs, then gradients.
    illumination: Buffer<f32>,
    photograph: Buffer<f32>,
    d_colors: Buffer<f32>,
    d_denoised: Buffer<f32>,
    d_noise: Buffer<f32>,
    d_illumination: Buffer<f32>,
    d_output: Buffer<f32>,
}

impl NetworkTerms {
    /// The networks and terms of the parts that are on, with memory for views of these sizes; none where no part has any.
    ///
    /// # Errors
    /// The device is out of memory.
    pub(super) fn new(gpu: &Gpu, config: &TrainConfig, sizes: &[UVec2]) -> Result<Option<Self>> {
        let ModelConfig { weights, denoiser_crop, .. } = &config.model;
        if !config.model.denoiser && !config.model.tonemapper {
            return Ok(None);
        }
        let seed = Stream::new(config.seed, streams::NETWORKS).bits(0);
        let networks = Networks::new(gpu, &config.model, config.model.features(), seed)?;
        let empty = |name| gpu.uninit(name, 0);
        let mut terms = Self {
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
                    terms: [Term::LOW_L1, Term::LOW_SSIM],
                },
            )?,
            no_curve: gpu.buffer(
                "no_curve",
                &[ToneParameters { white: 1.0, gain: 1.0, ..ToneParameters::default() }],
            )?,
            illumination: empty("window_illumination")?,
            photograph: empty("window_photograph")?,
            d_colors: empty("d_window_colors")?,
            d_denoised: empty("d_window_denoised")?,
            d_noise: empty("d_window_noise")?,
            d_illumination: empty("d_window_illumination")?,
            d_output: empty("d_window_output")?,
            networks,
        };
        sizes.iter().try_for_each(|&size| terms.reserve(gpu, size))?;
        Ok(Some(terms))
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

    /// Records the networks' step: adds to `dL/dR_0` and writes the planes of noise and illumination in `d_render`,
    /// (channels, H, W). `photograph` is the dark one of the view, (3, H, W).
    pub(super) fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        &TermInputs { step, size, features, render, .. }: &TermInputs<'_>,
        photograph: &Buffer<f32>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
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
            let own = &mut self.photograph;
            windows.gather(pass, photograph, size, 0..COLOR_CHANNELS, &window, own)?;
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
