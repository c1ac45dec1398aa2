//! What black and white are in the files of a set, where their format does not say.
//!
//! Integer files count as sRGB-encoded from 0 to the largest code, float files as linear light with white at 1.
//! `level_search` finds the levels of sets that are stored otherwise.

use std::str::FromStr;

use nightsplat_core::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{Image, srgb_from_linear};

/// How integer files store light.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StoredLight {
    /// Encoded as sRGB, on the full scale; levels are as the format says.
    Srgb,
    /// Linear, without a transfer curve; a colour profile is not used.
    Linear,
}

impl StoredLight {
    /// Their names.
    #[doc(hidden)]
    pub const NAMES: [&'static str; 2] = ["srgb", "linear"];
}

impl FromStr for StoredLight {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match name {
            "srgb" => Ok(Self::Srgb),
            "linear" => Ok(Self::Linear),
            _ => Err(Error::Usage(format!("unknown light `{name}`; srgb or linear"))),
        }
    }
}

/// How the values of a file are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SampleFormat {
    Eight,
    Sixteen,
    Float,
}

impl SampleFormat {
    /// The largest code; 1 for floats.
    pub(super) fn largest(self) -> f32 {
        match self {
            Self::Eight => 255.0,
            Self::Sixteen => 65_535.0,
            Self::Float => 1.0,
        }
    }
}

/// Black and white of the files of a set; by default as their formats say.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Levels {
    pub(super) light: Option<StoredLight>,
    pub(super) found: Option<FoundLevels>,
}

/// Levels of one format that are not those of its scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct FoundLevels {
    pub(super) format: SampleFormat,
    /// In codes, or in the unit of floats.
    pub(super) black: f32,
    pub(super) white: f32,
    /// Whether no value may be outside.
    pub(super) are_limits: bool,
}

/// The smallest and the largest value of an image.
pub(super) fn extremes(image: &Image) -> [f32; 2] {
    let both = |[low, high]: [f32; 2], &x: &f32| [x.min(low), x.max(high)];
    image.data.iter().fold([f32::INFINITY, f32::NEG_INFINITY], both)
}

impl Levels {
    /// The levels as the formats say.
    pub fn as_stored(light: Option<StoredLight>) -> Self {
        Self { light, found: None }
    }

    /// Says what was found, in a line.
    pub fn say(&self) {
        self.line().iter().for_each(|line| tracing::warn!("{line}"));
    }

    /// What was found; `None` if levels are as stored.
    pub(super) fn line(&self) -> Option<String> {
        let FoundLevels { format, black, white, are_limits } = self.found?;
        let kept = "`--light srgb` takes them as they are";
        Some(match (format, are_limits) {
            (SampleFormat::Eight, _) => format!(
                "no value of the photographs is below {black} or above {white} of 255, the range of video: stretched \
                 to all of it; {kept}"
            ),
            (SampleFormat::Sixteen, true) => {
                let linear = match self.light {
                    Some(_) => "",
                    None => "; if a sensor's values are linear light, `--light linear`",
                };
                format!(
                    "no value of the 16-bit photographs is above {white}, which counts as white{linear}; {kept}"
                )
            }
            (SampleFormat::Sixteen, false) => format!(
                "the values of the 16-bit photographs are {black} to {white} of 65535, {:.1} % of the scale: \
                 stretched to all of it; {kept}",
                100.0 * (white - black) / format.largest()
            ),
            (SampleFormat::Float, _) => format!(
                "most values of the photographs exceed 1, so that their unit is not white: {white:.4} counts as white \
                 in all of them; {kept}"
            ),
        })
    }

    /// The factor from linear light of value 1 to the unit of the files.
    pub fn unit(&self) -> f32 {
        let of_floats = self.found.filter(|found| found.format == SampleFormat::Float);
        of_floats.map_or(1.0, |found| found.white)
    }

    /// Whether no value of the set may exceed them.
    pub fn are_limits(&self) -> bool {
        self.found.is_some_and(|found| found.are_limits)
    }

    /// Whether the values are not sRGB-encoded.
    pub(super) fn are_linear(&self) -> bool {
        self.light == Some(StoredLight::Linear)
    }

    /// Maps values of a format, as parts of its scale, to parts of the range of these levels, and encodes linear light;
    /// returns whether a value is beyond what levels of this kind allow.
    pub(super) fn apply(&self, image: &mut Image, format: SampleFormat) -> bool {
        let parts = image.data.par_chunks_mut(1 << 16);
        parts.map(|values| self.apply_to(values, format)).reduce(|| false, |a, b| a | b)
    }

    /// [`Self::apply`] for some values.
    pub(super) fn apply_to(&self, values: &mut [f32], format: SampleFormat) -> bool {
        let mut is_beyond = false;
        if let Some(found) = self.found.filter(|found| found.format == format) {
            let FoundLevels { black, white, are_limits, .. } = found;
            let (scale, range) = (format.largest(), white - black);
            let code = |x: f32| if format == SampleFormat::Float { x } else { (x * scale).round() };
            is_beyond = are_limits && values.iter().any(|&x| !(black..=white).contains(&code(x)));
            values.iter_mut().for_each(|x| *x = (code(*x) - black) / range);
        }
        if self.are_linear() && format != SampleFormat::Float {
            values.iter_mut().for_each(|x| *x = srgb_from_linear(*x));
        }
        is_beyond
    }
}
