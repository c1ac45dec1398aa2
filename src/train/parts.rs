//! What a model has beside colour: each part of LITA-GS with its own switch.

use std::path::PathBuf;
use std::str::FromStr;

use glam::UVec2;
use serde::{Deserialize, Serialize};

use crate::loss::{DepthBoxes, Weights};
use crate::networks::{Denoiser, DenoiserSettings, Form, Tonemapper};
use crate::splats::scene::Features;
use crate::{Error, Result};

/// The models that have a name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ModelName {
    /// Colour alone: 3DGS.
    Plain,
    /// Every part: LITA-GS, the paper's backbone.
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
    /// Stages of a network that take the noise from the render: R_0 to R_K.
    Denoiser,
    /// A network that darkens illumination times R_K to the dark photograph.
    Tonemapper,
    /// A feature that is held to the colour-invariant edges of the target.
    Structure,
    /// A feature that is held to a depth map from elsewhere.
    Depth,
}

impl Part {
    /// Every part, in the order of the paper.
    pub const ALL: [Self; 4] = [Self::Denoiser, Self::Tonemapper, Self::Structure, Self::Depth];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Denoiser => "denoiser",
            Self::Tonemapper => "tonemapper",
            Self::Structure => "structure",
            Self::Depth => "depth",
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

/// Which parts a model has beside colour, and their constants. The default is colour alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ModelConfig {
    /// [`Part::Denoiser`].
    pub denoiser: bool,
    /// [`Part::Tonemapper`].
    pub tonemapper: bool,
    /// [`Part::Structure`].
    pub structure: bool,
    /// [`Part::Depth`]; off for views without a depth map.
    pub depth: bool,
    /// Colours are the bare SH sum of LITA-GS instead of max(SH + 0.5, 0), what viewers show.
    pub raw_colors: bool,
    /// Side in pixels of the random crop that the networks train on; 0: the whole view.
    pub denoiser_crop: u32,
    /// Side in pixels of the boxes of the local depth term.
    pub depth_box: u32,
    /// A folder of depth maps, in place of `depth/` or `depth_maps/` of the dataset.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth_folder: Option<PathBuf>,
    /// The depth maps hold disparity: larger is nearer.
    pub depth_is_disparity: bool,
    /// The size of the denoiser, and what the networks begin as.
    pub network: DenoiserSettings,
    /// What each term weighs beside (1 - w) L1 + w (1 - SSIM).
    pub weights: Weights,
    /// Adam's learning rates of the networks.
    pub rates: NetworkRates,
}

/// Adam's learning rates, constant.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NetworkRates {
    /// Of the denoiser.
    pub denoiser: f64,
    /// Of the tonemapper.
    pub tonemapper: f64,
}

impl Default for ModelConfig {
    fn default() -> Self {
        Self {
            denoiser: false,
            tonemapper: false,
            structure: false,
            depth: false,
            raw_colors: false,
            denoiser_crop: 0,
            depth_box: 128,
            depth_folder: None,
            depth_is_disparity: false,
            network: DenoiserSettings::default(),
            weights: Weights::default(),
            rates: NetworkRates::default(),
        }
    }
}

/// A denoiser that begins as the identity learns in hundreds of steps at ten times the paper's rate.
impl Default for NetworkRates {
    fn default() -> Self {
        Self { denoiser: 5e-4, ..Self::paper() }
    }
}

impl NetworkRates {
    /// Those of LITA-GS.
    pub fn paper() -> Self {
        Self { denoiser: Denoiser::LEARNING_RATE, tonemapper: Tonemapper::LEARNING_RATE }
    }
}

impl ModelConfig {
    /// Says where the parts of a model see less than they are set to.
    pub(super) fn say_what_parts_see(&self, sizes: &[UVec2]) {
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
    pub fn has(&self, part: Part) -> bool {
        match part {
            Part::Denoiser => self.denoiser,
            Part::Tonemapper => self.tonemapper,
            Part::Structure => self.structure,
            Part::Depth => self.depth,
        }
    }

    /// Sets what of the parts' constants is LITA-GS's own: how large the networks are, that they begin at random, how fast
    /// they learn, and the denoiser's smoothness.
    pub fn follow_paper(&mut self) {
        let precision = self.network.precision;
        self.network = DenoiserSettings { precision, ..DenoiserSettings::paper() };
        self.rates = NetworkRates::paper();
        self.weights.total_variation = Weights::paper().total_variation;
    }

    /// Switches exactly these parts on.
    pub fn set_parts(&mut self, parts: &[Part]) {
        self.denoiser = parts.contains(&Part::Denoiser);
        self.tonemapper = parts.contains(&Part::Tonemapper);
        self.structure = parts.contains(&Part::Structure);
        self.depth = parts.contains(&Part::Depth);
    }

    /// What the Gaussians carry for the parts that are on.
    pub fn features(&self) -> Features {
        Features {
            depth: self.depth,
            structure: self.structure,
            // Beside the colours a noise map can say nothing: what it takes away the colours need not show.
            noise: self.denoiser && self.network.form == Form::Paper,
            illumination: self.tonemapper,
        }
    }

    /// # Errors
    /// [`Error::Usage`] names a value that makes no sense.
    pub(super) fn check(&self) -> Result<()> {
        self.network.check()?;
        let NetworkRates { denoiser, tonemapper } = self.rates;
        for (name, rate) in [("denoiser", denoiser), ("tonemapper", tonemapper)] {
            if !(rate.is_finite() && rate >= 0.0) {
                let problem = format!("model.rates.{name} is {rate}; it must be 0 or more");
                return Err(Error::Usage(problem));
            }
        }
        if self.depth_box < 2 {
            let problem = format!("model.depth_box is {}; it must be at least 2", self.depth_box);
            return Err(Error::Usage(problem));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_part_brings_its_channels() {
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
    fn a_rate_that_makes_no_sense_is_refused_by_name() {
        let mut model = ModelConfig::default();
        model.rates.denoiser = f64::NAN;
        assert!(model.check().unwrap_err().to_string().contains("rates.denoiser"));
    }
}
