//! The networks in a training step: crop of the render, forward, loss terms, backward.

use glam::UVec2;
use nightsplat_core::random::Stream;
use nightsplat_models::gaussians::{COLOR_CHANNELS, Feature};

use super::config::TrainConfig;
use super::masks::Masking;
use super::networks::Networks;
use super::parts::ModelConfig;
use super::streams;
use crate::gpu::{Buffer, Gpu, Recorder};
use crate::kernels::ssim_window::RADIUS;
use crate::loss::{
    DenoisingLoss, Gradient, LogSlot, Loss, LossInputs, LossRegion, Term, TermInputs,
};
use crate::networks::crop::PaddedCrop;
use crate::networks::{Denoiser, NetworkVariant};
use crate::{Error, Result};

/// The images of a view that are targets of the networks, (3, H, W) each.
#[derive(Clone, Copy, Debug)]
pub(super) struct Photographs<'a> {
    /// The mask, (H, W); `None`: all pixels count.
    pub(super) mask: Option<&'a Buffer<f32>>,
    /// The dark photograph.
    pub(super) low: &'a Buffer<f32>,
    /// Its target; the paper's networks do not use it.
    pub(super) target: &'a Buffer<f32>,
}

/// The networks in training, with the loss terms of their outputs.
#[derive(Debug)]
pub(super) struct NetworkTerms {
    pub(super) networks: Networks,
    variant: NetworkVariant,
    /// Side of the random crop in pixels; 0: the whole view.
    crop: u32,
    crops: Stream,
    denoising: DenoisingLoss,
    low: Loss,
    /// `None` if no view has a mask.
    masking: Option<CropMask>,
    /// Inputs of the crop and their gradients, (3, h, w) each.
    illumination: Buffer<f32>,
    /// The image that an output is compared with.
    photograph: Buffer<f32>,
    d_colors: Buffer<f32>,
    d_denoised: Buffer<f32>,
    /// The gradient of the noise map, the input of the denoiser's first stage.
    d_noise: Buffer<f32>,
    d_illumination: Buffer<f32>,
    d_output: Buffer<f32>,
}

/// The mask of a crop.
#[derive(Debug)]
struct CropMask {
    masking: Masking,
    /// (h, w)
    weights: Buffer<f32>,
}

impl CropMask {
    /// [`Masking::shown`] for a crop.
    fn shown(
        &mut self,
        pass: &mut Recorder<'_>,
        size: UVec2,
        output: &Buffer<f32>,
        held_to: &Buffer<f32>,
    ) -> Result<&Buffer<f32>> {
        self.masking.shown(pass, &self.weights, size, output, held_to)
    }

    /// [`Masking::hide`] for the colours of a crop.
    fn hide(&self, pass: &mut Recorder<'_>, size: UVec2, d_output: &mut Buffer<f32>) -> Result<()> {
        self.masking.hide(pass, &self.weights, size, COLOR_CHANNELS, d_output)
    }
}

impl NetworkTerms {
    /// The networks and terms of the enabled parts, with memory for views of these sizes, some with masks; `None` if no
    /// part has a network.
    pub(super) fn new(
        gpu: &Gpu,
        config: &TrainConfig,
        sizes: &[UVec2],
        is_masked: bool,
    ) -> Result<Option<Self>> {
        let ModelConfig { weights, denoiser_crop, .. } = &config.model;
        if !config.model.denoiser && !config.model.tonemapper {
            return Ok(None);
        }
        let seed = Stream::new(config.seed, streams::NETWORKS).bits(0);
        let networks = Networks::new(gpu, &config.model, config.model.features(), seed)?;
        let empty = |name| gpu.uninit(name, 0);
        let mut terms = Self {
            variant: config.model.network.variant,
            crop: *denoiser_crop,
            crops: Stream::new(config.seed, streams::CROPS),
            denoising: DenoisingLoss::new(gpu, weights)?,
            low: Loss::new(
                gpu,
                weights.low_ssim,
                [Term::LOW_L1, Term::LOW_SSIM],
                Gradient::Written,
            )?,
            masking: None,
            illumination: empty("crop_illumination")?,
            photograph: empty("crop_photograph")?,
            d_colors: empty("d_crop_colors")?,
            d_denoised: empty("d_crop_denoised")?,
            d_noise: empty("d_crop_noise")?,
            d_illumination: empty("d_crop_illumination")?,
            d_output: empty("d_crop_output")?,
            networks,
        };
        sizes.iter().try_for_each(|&size| terms.reserve(gpu, size))?;
        if is_masked {
            let values = terms.photograph.len();
            terms.masking = Some(CropMask {
                masking: Masking::new(gpu, values)?,
                weights: gpu.uninit("crop_mask", values / COLOR_CHANNELS)?,
            });
        }
        Ok(Some(terms))
    }

    /// Keeps the activations of every stage of the denoiser, for crops of views of these sizes, if they take at most
    /// `most` bytes and the device has that memory.
    pub(super) fn keep_activations(&mut self, sizes: &[UVec2], most: u64) -> Result<()> {
        let crops: Vec<UVec2> = sizes.iter().map(|&size| self.max_of(size)).collect();
        let Some(denoiser) = &mut self.networks.denoiser else { return Ok(()) };
        let mut kept =
            crops.into_iter().map(|padded_crop| denoiser.keep_activations(padded_crop, most));
        let are_kept = kept.try_fold(true, |all, kept| Ok::<_, Error>(all & kept?))?;
        tracing::debug!("activations of every stage of the denoiser kept: {are_kept}");
        Ok(())
    }

    /// The largest crop of a view of `size`.
    fn max_of(&self, size: UVec2) -> UVec2 {
        match self.crop {
            0 => size,
            crop => size.min(UVec2::splat(crop.saturating_add(2 * self.margin()))),
        }
    }

    /// Reserves memory for the crops of views of `size`.
    fn reserve(&mut self, gpu: &Gpu, size: UVec2) -> Result<()> {
        let size = self.max_of(size);
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
            buffer.grow(gpu, values)?;
        }
        Ok(())
    }

    /// The radius of the terms around a pixel, in pixels.
    fn margin(&self) -> u32 {
        let denoiser = self.networks.denoiser.as_ref().map_or(0, Denoiser::margin);
        let tonemapper = self.networks.tonemapper.as_ref();
        denoiser + tonemapper.map_or(0, |tonemapper| tonemapper.margin() + RADIUS as u32)
    }

    /// Whether a network is trained against the targets.
    pub(super) fn follow_target(&self) -> bool {
        self.variant == NetworkVariant::Identity && self.networks.has_denoiser()
    }

    /// Records the networks' step: adds to `dL/dR_0`, and writes the planes of noise and illumination in `d_render`,
    /// (channels, H, W).
    pub(super) fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: &TermInputs<'_>,
        photographs: Photographs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let padded_crop = match self.crop {
            0 => PaddedCrop::whole(inputs.size),
            crop => PaddedCrop::random(inputs.size, crop, self.margin(), &self.crops, inputs.step),
        };
        self.networks.denoise(pass, inputs.render, inputs.size, &padded_crop)?;
        if let Some((mask, CropMask { weights, .. })) = photographs.mask.zip(self.masking.as_mut())
        {
            self.networks.crops.gather(pass, mask, inputs.size, 0..1, &padded_crop, weights)?;
        }
        match self.variant {
            NetworkVariant::Identity => {
                // Stop-gradient: the denoiser does not affect the render.
                self.record_denoising(pass, &padded_crop, photographs, inputs.size, log)?;
                self.denoise_backward(pass, &padded_crop, inputs, d_render)?;
                pass.fill(&mut self.d_colors, 0);
                self.record_low(pass, &padded_crop, inputs, photographs, d_render, log)?;
            }
            NetworkVariant::Paper => {
                pass.fill(&mut self.d_colors, 0);
                self.record_denoising(pass, &padded_crop, photographs, inputs.size, log)?;
                self.record_low(pass, &padded_crop, inputs, photographs, d_render, log)?;
                self.denoise_backward(pass, &padded_crop, inputs, d_render)?;
            }
        }
        let crops = &self.networks.crops;
        crops.scatter(pass, &self.d_colors, &padded_crop, 0..COLOR_CHANNELS, inputs.size, d_render)
    }

    /// R_K against the target, or in the paper's variant against R_0.
    fn record_denoising(
        &mut self,
        pass: &mut Recorder<'_>,
        padded_crop: &PaddedCrop,
        photographs: Photographs<'_>,
        size: UVec2,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let Networks { denoiser: Some(denoiser), crops, colors, .. } = &self.networks else {
            return Ok(());
        };
        if !self.denoising.is_on() {
            pass.fill(&mut self.d_denoised, 0);
            pass.fill(&mut self.d_colors, 0);
            return Ok(());
        }
        let held_to = match self.variant {
            NetworkVariant::Identity => {
                let photograph = &mut self.photograph;
                let target = photographs.target;
                crops.gather(pass, target, size, 0..COLOR_CHANNELS, padded_crop, photograph)?;
                &*photograph
            }
            NetworkVariant::Paper => colors,
        };
        let mut mask = self.masking.as_mut().filter(|_| photographs.mask.is_some());
        let denoised = match &mut mask {
            Some(mask) => mask.shown(pass, padded_crop.size, denoiser.denoised(), held_to)?,
            None => denoiser.denoised(),
        };
        self.denoising.record(
            pass,
            LossInputs {
                size: padded_crop.size,
                loss_region: loss_region(padded_crop),
                render: denoised,
                target: held_to,
            },
            &mut self.d_denoised,
            &mut self.d_colors,
            log,
        )?;
        let Some(mask) = mask else { return Ok(()) };
        mask.hide(pass, padded_crop.size, &mut self.d_denoised)?;
        mask.hide(pass, padded_crop.size, &mut self.d_colors)
    }

    /// Propagates `dL/dR_K` to the noise map, and to R_0 in `d_colors`.
    fn denoise_backward(
        &mut self,
        pass: &mut Recorder<'_>,
        padded_crop: &PaddedCrop,
        &TermInputs { size, features, .. }: &TermInputs<'_>,
        d_render: &mut Buffer<f32>,
    ) -> Result<()> {
        let Networks { denoiser, crops, colors, noise, .. } = &mut self.networks;
        let Some(denoiser) = denoiser else { return Ok(()) };
        let planes = features.channels_of(Feature::Noise);
        denoiser.backward(
            pass,
            padded_crop.size,
            if planes.is_some() { noise } else { colors },
            colors,
            &self.d_denoised,
            &mut self.d_noise,
            &mut self.d_colors,
        )?;
        match planes {
            Some(planes) => crops.scatter(pass, &self.d_noise, padded_crop, planes, size, d_render),
            None => Ok(()),
        }
    }

    /// The dark photograph from illumination and R_K, or R_0 in the identity variant, and the gradients of both.
    fn record_low(
        &mut self,
        pass: &mut Recorder<'_>,
        padded_crop: &PaddedCrop,
        &TermInputs { size: whole, features, render, .. }: &TermInputs<'_>,
        Photographs { mask, low, .. }: Photographs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let size = padded_crop.size;
        let Networks { denoiser, tonemapper, crops, colors, .. } = &mut self.networks;
        let Some((tonemapper, planes)) =
            tonemapper.as_mut().zip(features.channels_of(Feature::Illumination))
        else {
            return Ok(());
        };
        crops.gather(pass, render, whole, planes.clone(), padded_crop, &mut self.illumination)?;
        crops.gather(pass, low, whole, 0..COLOR_CHANNELS, padded_crop, &mut self.photograph)?;
        let (denoised, d_denoised) = match denoiser.as_ref() {
            Some(denoiser) if self.variant == NetworkVariant::Paper => {
                (denoiser.denoised(), &mut self.d_denoised)
            }
            _ => (&*colors, &mut self.d_colors),
        };
        tonemapper.forward(pass, size, &self.illumination, denoised)?;
        let mut mask = self.masking.as_mut().filter(|_| mask.is_some());
        let output = match &mut mask {
            Some(mask) => mask.shown(pass, size, tonemapper.output(), &self.photograph)?,
            None => tonemapper.output(),
        };
        self.low.record(
            pass,
            LossInputs {
                size,
                loss_region: loss_region(padded_crop),
                render: output,
                target: &self.photograph,
            },
            &mut self.d_output,
            log,
        )?;
        if let Some(mask) = mask {
            mask.hide(pass, size, &mut self.d_output)?;
        }
        let d_illumination = &mut self.d_illumination;
        tonemapper.backward(
            pass,
            size,
            &self.illumination,
            denoised,
            &self.d_output,
            d_illumination,
            d_denoised,
        )?;
        crops.scatter(pass, d_illumination, padded_crop, planes, whole, d_render)
    }
}

/// The pixels of a crop that the terms count.
fn loss_region(padded_crop: &PaddedCrop) -> LossRegion {
    LossRegion { origin: padded_crop.crop_origin, size: padded_crop.crop_size }
}
