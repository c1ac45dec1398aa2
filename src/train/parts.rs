//! Parts of the model in addition to colour, each of which can be on or off: those of LITA-GS, and a lamp.

use std::path::PathBuf;
use std::str::FromStr;

use glam::UVec2;
use nightsplat_core::settings;
use nightsplat_core::settings::Rule;

use nightsplat_models::gaussians::Features;
use nightsplat_photographs::dataset::NormalAxes;

use crate::loss::{DepthBoxes, Weights};
use crate::networks::{Denoiser, DenoiserSettings, NetworkVariant, Tonemapper};
use crate::{Error, Result};

/// Named models.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ModelName {
    /// Colour alone: 3DGS.
    Plain,
    /// Every part of LITA-GS, the paper's backbone.
    Lita,
}

impl FromStr for ModelName {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match name {
            "plain" => Ok(Self::Plain),
            "lita" => Ok(Self::Lita),
            _ => Err(Error::Usage(format!("unknown model `{name}`; plain or lita"))),
        }
    }
}

/// A part of the model that can be on or off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// A network that removes noise from the render in stages: R_0 to R_K.
    Denoiser,
    /// A network that maps illumination times R_K to the dark photograph.
    Tonemapper,
    /// A feature trained against the colour-invariant edges of the target.
    Structure,
    /// A feature trained against a given depth map.
    Depth,
    /// A lamp that moves with the camera.
    Lamp,
    /// A term that compares the normals of rendered depths with given ones.
    Normals,
}

impl Part {
    /// Every part: those of the paper, in its order, and then others.
    pub const ALL: [Self; 6] =
        [Self::Denoiser, Self::Tonemapper, Self::Structure, Self::Depth, Self::Lamp, Self::Normals];

    /// The parts of LITA-GS.
    #[doc(hidden)]
    pub const LITA: [Self; 4] = [Self::Denoiser, Self::Tonemapper, Self::Structure, Self::Depth];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Denoiser => "denoiser",
            Self::Tonemapper => "tonemapper",
            Self::Structure => "structure",
            Self::Depth => "depth",
            Self::Lamp => "lamp",
            Self::Normals => "normals",
        }
    }
}

impl FromStr for Part {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|part| part.name() == name).ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            Error::Usage(format!("unknown part `{name}`; the parts are {names}"))
        })
    }
}

settings! {
"model."
/// The parts of a model in addition to colour, and their constants. The default is colour alone.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelConfig {
    /// A network that removes noise from the render.
    denoiser: bool = false => Rule::Flag;
    /// A network that maps illumination times the render to the dark photograph.
    tonemapper: bool = false => Rule::Flag;
    /// A feature that is held to the colour-invariant edges of the target.
    structure: bool = false => Rule::Flag;
    /// A feature trained against a given depth map; not for views without one.
    depth: bool = false => Rule::Flag;
    /// A lamp that moves with the camera: colours are multiplied by its light, whose numbers are learned.
    lamp: bool = false => Rule::Flag;
    /// Normals of the rendered depths are held to given normal maps; not for views without one.
    normals: bool = false => Rule::Flag;
    /// Colour is the SH sum alone, as in LITA-GS, instead of max(SH + 0.5, 0), as in viewers.
    raw_colors: bool = false => Rule::Flag, "--raw-colors on|off";
    /// Train the networks on random crops of at most N x N pixels; 0: on whole views.
    denoiser_crop: u32 = 0 => Rule::Whole(0, u32::MAX as u64), in "pixels", "--denoiser-crop N";
    /// The side of the boxes of the local depth term.
    depth_box: u32 = 128 => Rule::Whole(2, u32::MAX as u64), in "pixels";
    /// Folder of depth maps, `NAME.*` or `depth_NAME.*`, in which larger is farther.
    depth_folder: Option<PathBuf> = None, "depth/ or depth_maps/ of the dataset" => Rule::PATH, "--depth DIR";
    /// Depth maps hold disparity, in which larger is nearer.
    depth_is_disparity: bool = false => Rule::Flag, "--depth-is-disparity";
    /// Folder of normal maps in the camera's axes, `NAME.*` or `normal_NAME.*`: of 8 or 16 bits from -1 to 1, or EXR.
    normal_folder: Option<PathBuf> = None, "normals/ or normal_maps/ of the dataset" => Rule::PATH, "--normals DIR";
    /// The axes of normal maps: OpenCV's, y down and z away from the camera, or OpenGL's, y up and z towards it; auto:
    /// those in which a map faces the camera.
    normal_axes: NormalAxes = NormalAxes::Auto => Rule::OneOf(&NormalAxes::NAMES);
}
sections {
    /// The size of the denoiser, and the variant of the networks.
    network: DenoiserSettings;
    /// Weights of the terms in addition to (1 - w) L1 + w (1 - SSIM).
    weights: Weights;
    /// Adam's learning rates of the networks.
    rates: NetworkRates;
}
}

settings! {
"model.rates."
/// Adam's learning rates of the networks, constant. A denoiser that starts as the identity learns at ten times the
/// paper's rate, within hundreds of steps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NetworkRates {
    /// Adam's rate of the denoiser.
    denoiser: f64 = 5e-4 => Rule::POSITIVE_OR_0;
    /// Adam's rate of the tonemapper.
    tonemapper: f64 = Tonemapper::LEARNING_RATE => Rule::POSITIVE_OR_0;
}
}

impl NetworkRates {
    /// The rates of LITA-GS.
    pub(crate) fn paper() -> Self {
        Self { denoiser: Denoiser::LEARNING_RATE, tonemapper: Tonemapper::LEARNING_RATE }
    }
}

impl ModelConfig {
    /// The weights of the terms: 0 for parts that are off.
    pub(super) fn effective_weights(&self) -> Weights {
        let of = |has: bool, weight: f64| if has { weight } else { 0.0 };
        let Weights { denoising, total_variation, low_ssim, structure, depth, normals } =
            self.weights;
        Weights {
            denoising: of(self.denoiser, denoising),
            total_variation: of(self.denoiser, total_variation),
            low_ssim,
            structure: of(self.structure, structure),
            depth: of(self.depth, depth),
            normals: of(self.normals, normals),
        }
    }

    /// Logs boxes or crops that are larger than the views.
    pub(super) fn log_parts(&self, sizes: &[UVec2]) {
        let shortest = sizes.iter().map(|size| size.min_element()).min().unwrap_or_default();
        let boxes = DepthBoxes::new(UVec2::splat(shortest), self.depth_box);
        if self.depth && boxes.side < self.depth_box {
            let (wanted, side) = (self.depth_box, boxes.side);
            tracing::warn!(
                "depth boxes of {wanted} pixels exceed the views: {side} pixels in the smallest"
            );
        }
        let longest = sizes.iter().map(|size| size.max_element()).max().unwrap_or_default();
        if (self.denoiser || self.tonemapper) && self.denoiser_crop > longest {
            let crop = self.denoiser_crop;
            tracing::warn!(
                "a crop of {crop} pixels exceeds every view: the networks see whole views"
            );
        }
    }

    /// Whether a part is on.
    pub(crate) fn has(&self, part: Part) -> bool {
        match part {
            Part::Denoiser => self.denoiser,
            Part::Tonemapper => self.tonemapper,
            Part::Structure => self.structure,
            Part::Depth => self.depth,
            Part::Lamp => self.lamp,
            Part::Normals => self.normals,
        }
    }

    /// Sets LITA-GS's constants of the parts: size, random initialisation and learning rate of the networks, and the
    /// denoiser's total variation.
    #[doc(hidden)]
    pub fn follow_paper(&mut self) {
        let precision = self.network.precision;
        self.network = DenoiserSettings { precision, ..DenoiserSettings::paper() };
        self.rates = NetworkRates::paper();
        self.weights.total_variation = Weights::paper().total_variation;
    }

    /// Enables exactly these parts.
    #[doc(hidden)]
    pub fn set_parts(&mut self, parts: &[Part]) {
        self.denoiser = parts.contains(&Part::Denoiser);
        self.tonemapper = parts.contains(&Part::Tonemapper);
        self.structure = parts.contains(&Part::Structure);
        self.depth = parts.contains(&Part::Depth);
        self.lamp = parts.contains(&Part::Lamp);
        self.normals = parts.contains(&Part::Normals);
    }

    /// The features of the Gaussians for the enabled parts.
    pub(crate) fn features(&self) -> Features {
        Features {
            depth: self.depth,
            structure: self.structure,
            // A noise map is redundant: the colours need not contain what it removes.
            noise: self.denoiser && self.network.variant == NetworkVariant::Paper,
            illumination: self.tonemapper,
        }
    }

    pub(super) fn check(&self) -> Result<()> {
        self.check_rows()?;
        self.network.check_rows()?;
        self.weights.check_rows()?;
        self.rates.check_rows()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_part_adds_its_channels() {
        let mut model = ModelConfig::default();
        model.set_parts(&Part::ALL);
        assert_eq!(model.features().channels(), 8, "no noise map");
        model.follow_paper();
        for (parts, channels) in [
            (&[][..], 3),
            (&[Part::Depth], 4),
            (&[Part::Depth, Part::Structure], 5),
            (&[Part::Denoiser], 6),
            (&[Part::Structure, Part::Tonemapper], 7),
            (&Part::ALL, 11),
        ] {
            model.set_parts(parts);
            assert_eq!(model.features().channels(), channels);
            assert!(Part::ALL.iter().all(|&part| model.has(part) == parts.contains(&part)));
        }
    }

    #[test]
    fn an_invalid_rate_is_refused_by_name() {
        let mut model = ModelConfig::default();
        model.rates.denoiser = f64::NAN;
        assert!(model.check().unwrap_err().to_string().contains("rates.denoiser"));
    }
}
