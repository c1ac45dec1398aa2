//! The networks of a model, applied to renders.

use std::path::Path;

use glam::UVec2;
use nightsplat_models::gaussians::{COLOR_CHANNELS, Feature, Features};
use nightsplat_photographs::image::Image;

use super::parts::ModelConfig;
use crate::gpu::{Buffer, Gpu, Recorder};
use crate::networks::crop::{CropKernels, PaddedCrop};
use crate::networks::{self, Denoiser, Parameters, Tonemapper};
use crate::{Error, Result};

/// The networks of a model, and the crop of the render that is their input.
#[derive(Debug)]
pub struct Networks {
    gpu: Gpu,
    features: Features,
    pub(super) denoiser: Option<Denoiser>,
    pub(super) tonemapper: Option<Tonemapper>,
    pub(super) crops: CropKernels,
    /// R_0 of the crop, (3, h, w).
    pub(super) colors: Buffer<f32>,
    /// The noise map of the crop, (3, h, w).
    pub(super) noise: Buffer<f32>,
}

impl Networks {
    /// The networks of the enabled parts, with initial weights, for renders of Gaussians with these features.
    pub(crate) fn new(
        gpu: &Gpu,
        model: &ModelConfig,
        features: Features,
        seed: u64,
    ) -> Result<Self> {
        let takes = [
            (model.features().noise, Feature::Noise, "denoiser", "noise"),
            (model.tonemapper, Feature::Illumination, "tonemapper", "illumination"),
        ];
        for (is_on, feature, network, name) in takes {
            if is_on && features.channels_of(feature).is_none() {
                let problem = format!("the Gaussians have no {name}, which the {network} requires");
                return Err(Error::Usage(problem));
            }
        }
        let denoiser = model.denoiser.then(|| Denoiser::new(gpu, model.network, seed));
        let tonemapper =
            model.tonemapper.then(|| Tonemapper::new(gpu, model.network.variant, seed));
        let (mut denoiser, mut tonemapper) = (denoiser.transpose()?, tonemapper.transpose()?);
        if let Some(denoiser) = &mut denoiser {
            denoiser.parameters_mut().learning_rate = model.rates.denoiser;
        }
        if let Some(tonemapper) = &mut tonemapper {
            tonemapper.parameters_mut().learning_rate = model.rates.tonemapper;
        }
        Ok(Self {
            gpu: gpu.clone(),
            features,
            denoiser,
            tonemapper,
            crops: CropKernels::new(gpu)?,
            colors: gpu.uninit("crop_colors", 0)?,
            noise: gpu.uninit("crop_noise", 0)?,
        })
    }

    /// Whether there is a denoiser.
    pub(crate) fn has_denoiser(&self) -> bool {
        self.denoiser.is_some()
    }

    /// Reserves memory for crops up to `size`.
    pub(super) fn reserve(&mut self, size: UVec2) -> Result<()> {
        let values = COLOR_CHANNELS * size.x as usize * size.y as usize;
        self.colors.grow(&self.gpu, values)?;
        if let Some(denoiser) = &mut self.denoiser {
            denoiser.reserve(size)?;
            if self.features.noise {
                self.noise.grow(&self.gpu, values)?;
            }
        }
        match &mut self.tonemapper {
            Some(tonemapper) => tonemapper.reserve(size),
            None => Ok(()),
        }
    }

    /// Records the denoiser on a crop of `render`, (channels, H, W) of a view of `size`.
    pub(super) fn denoise(
        &mut self,
        pass: &mut Recorder<'_>,
        render: &Buffer<f32>,
        size: UVec2,
        crop: &PaddedCrop,
    ) -> Result<()> {
        let planes = 0..COLOR_CHANNELS;
        self.crops.gather(pass, render, size, planes, crop, &mut self.colors)?;
        let Some(denoiser) = &mut self.denoiser else { return Ok(()) };
        let Some(planes) = self.features.channels_of(Feature::Noise) else {
            return denoiser.forward(pass, crop.size, &self.colors, &self.colors);
        };
        self.crops.gather(pass, render, size, planes, crop, &mut self.noise)?;
        denoiser.forward(pass, crop.size, &self.noise, &self.colors)
    }

    /// R_K of the last crop; R_0 without a denoiser.
    pub(super) fn denoised(&self) -> &Buffer<f32> {
        self.denoiser.as_ref().map_or(&self.colors, Denoiser::denoised)
    }

    /// R_K of a whole render, (channels, H, W); R_0 without a denoiser.
    pub(crate) fn denoised_image(&mut self, render: &[f32], size: UVec2) -> Result<Image> {
        self.reserve(size)?;
        let gpu = self.gpu.clone();
        let render = gpu.buffer("render", render)?;
        gpu.run("denoise", |pass| self.denoise(pass, &render, size, &PaddedCrop::whole(size)))?;
        let mut data = gpu.read(self.denoised())?;
        data.truncate(COLOR_CHANNELS * size.x as usize * size.y as usize);
        Ok(Image { width: size.x, height: size.y, data })
    }

    /// Whether the device can bind the feature maps of a view of `size`.
    pub(super) fn fits(&self, size: UVec2) -> bool {
        self.denoiser
            .as_ref()
            .is_none_or(|denoiser| Denoiser::fits_on(&self.gpu, denoiser.settings(), size))
            && (self.tonemapper.is_none() || Tonemapper::fits_on(&self.gpu, size))
    }

    /// The radius of the denoiser's receptive field in pixels, without its norms, which cover the whole crop.
    pub(super) fn margin(&self) -> u32 {
        self.denoiser.as_ref().map_or(0, Denoiser::margin)
    }

    /// Writes the weights of every network.
    pub(crate) fn save(&self, path: &Path) -> Result<()> {
        let denoiser = self.denoiser.as_ref().map(Denoiser::parameters);
        let tonemapper = self.tonemapper.as_ref().map(Tonemapper::parameters);
        let parameters: Vec<&Parameters> = denoiser.into_iter().chain(tonemapper).collect();
        networks::save(path, &parameters, &self.gpu)
    }

    /// Reads the weights of every network.
    pub(crate) fn load(&mut self, path: &Path) -> Result<()> {
        let gpu = self.gpu.clone();
        let mut parameters: Vec<&mut Parameters> = self.parameters_mut().collect();
        networks::load(path, &mut parameters, &gpu)
    }

    /// The parameters of every network.
    pub(super) fn parameters_mut(&mut self) -> impl Iterator<Item = &mut Parameters> {
        let denoiser = self.denoiser.as_mut().map(Denoiser::parameters_mut);
        denoiser.into_iter().chain(self.tonemapper.as_mut().map(Tonemapper::parameters_mut))
    }
}
