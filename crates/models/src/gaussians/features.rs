//! Features: values that the rasteriser blends in addition to colour.

use std::ops::Range;

/// The render's channels before the features: RGB.
pub const COLOR_CHANNELS: usize = 3;

/// A value per Gaussian that a part of the model learns (LITA-GS), independent of the viewing direction and without an
/// activation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Feature {
    /// A free scalar that the depth loss determines; not the distance to the camera.
    Depth,
    /// Edge strength, compared with the colour invariant of the target.
    Structure,
    /// RGB: the input of the denoiser.
    Noise,
    /// RGB: the factor from the denoised render to the dark photograph.
    Illumination,
}

/// The description of a feature.
#[derive(Debug)]
pub struct FeatureSpec {
    /// The feature of this row.
    pub feature: Feature,
    /// The name on the command line and in errors.
    pub name: &'static str,
    /// Channels.
    pub width: usize,
    /// The prefix of its PLY properties (`f_NAME_0` and so on, as LITA-GS writes them).
    pub ply_name: &'static str,
}

/// The features in the order of their channels.
pub const FEATURES: [FeatureSpec; 4] = [
    FeatureSpec { feature: Feature::Depth, name: "depth", width: 1, ply_name: "depth" },
    FeatureSpec { feature: Feature::Structure, name: "structure", width: 1, ply_name: "prior" },
    FeatureSpec { feature: Feature::Noise, name: "noise", width: 3, ply_name: "noise" },
    FeatureSpec {
        feature: Feature::Illumination,
        name: "illumination",
        width: 3,
        ply_name: "illu",
    },
];

/// The features of a scene's Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Features {
    /// A free scalar that the depth loss determines; not the distance to the camera.
    pub depth: bool,
    /// Edge strength, compared with the colour invariant of the target.
    pub structure: bool,
    /// RGB: the input of the denoiser.
    pub noise: bool,
    /// RGB: the factor from the denoised render to the dark photograph.
    pub illumination: bool,
}

impl Features {
    /// No features: the model of 3DGS.
    pub const NONE: Self =
        Self { depth: false, structure: false, noise: false, illumination: false };
    /// All features.
    pub const ALL: Self = Self { depth: true, structure: true, noise: true, illumination: true };

    /// Whether the feature is present.
    #[doc(hidden)]
    pub const fn has(self, feature: Feature) -> bool {
        match feature {
            Feature::Depth => self.depth,
            Feature::Structure => self.structure,
            Feature::Noise => self.noise,
            Feature::Illumination => self.illumination,
        }
    }

    /// The rows of [`FEATURES`] that are present.
    #[doc(hidden)]
    pub fn specs(self) -> impl Iterator<Item = &'static FeatureSpec> {
        FEATURES.iter().filter(move |spec| self.has(spec.feature))
    }

    /// Floats per Gaussian.
    #[doc(hidden)]
    pub fn width(self) -> usize {
        self.specs().map(|spec| spec.width).sum()
    }

    /// Channels of a render: RGB and the features.
    #[doc(hidden)]
    pub fn channels(self) -> usize {
        COLOR_CHANNELS + self.width()
    }

    /// The channels of a render with the feature; `None` if the scene does not have it.
    #[doc(hidden)]
    pub fn channels_of(self, feature: Feature) -> Option<Range<usize>> {
        let mut begin = COLOR_CHANNELS;
        for spec in self.specs() {
            if spec.feature == feature {
                return Some(begin..begin + spec.width);
            }
            begin += spec.width;
        }
        None
    }

    /// The name of the PLY property for component `position` of the features.
    pub(super) fn ply_property(self, position: usize) -> String {
        let names = self.specs().flat_map(|spec| (0..spec.width).map(move |i| (spec.ply_name, i)));
        names.map(|(name, i)| format!("f_{name}_{i}")).nth(position).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_follow_one_another_without_gaps() {
        assert_eq!(Features::NONE.channels(), 3);
        assert_eq!(Features::ALL.channels(), 11);
        let begins = FEATURES.iter().map(|spec| Features::ALL.channels_of(spec.feature));
        assert!(begins.eq([Some(3..4), Some(4..5), Some(5..8), Some(8..11)]));
        let some = Features { structure: true, illumination: true, ..Features::NONE };
        assert_eq!(some.channels(), 7);
        assert_eq!(some.channels_of(Feature::Noise), None);
        assert_eq!(some.channels_of(Feature::Illumination), Some(4..7));
        let names: Vec<String> = (0..4).map(|i| some.ply_property(i)).collect();
        assert_eq!(names, ["f_prior_0", "f_illu_0", "f_illu_1", "f_illu_2"]);
    }
}
