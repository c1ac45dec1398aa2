//! The kinds of density control, and what a run does with each.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::Error;

/// How a Gaussian is densified.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DensityControl {
    /// Split into two halves along the longest axis, which together cover the same area: the render hardly changes.
    #[default]
    Conserving,
    /// As LITA-GS: a small one is cloned to a random position within it, a large one is replaced by two smaller ones at
    /// random positions. Opacities are never reset, and large Gaussians are not pruned.
    Paper,
}

/// What a kind of density control does in a run, beside its kernels.
#[derive(Clone, Copy, Debug)]
pub struct DensityStrategy {
    /// Its name in settings.
    pub name: &'static str,
    /// Splits keep the render: a Gaussian is split only where the views of the cameras hardly change, and a round that
    /// costs the training views is repeated with fewer splits.
    pub keeps_views: bool,
    /// Gaussians are scored by the sum of the gradients' norms of all pixels, not by the norm of their sum.
    pub adds_pixels: bool,
    /// The score from which a Gaussian is densified, unless a setting states another.
    pub gradient_threshold: f64,
    /// Each round takes its share of the headroom below the limit instead of all that is left.
    pub spreads_growth: bool,
    /// Where there are few points, the first round adds Gaussians at rendered depths.
    pub seeds_depths: bool,
}

impl DensityControl {
    const ALL: [Self; 2] = [Self::Conserving, Self::Paper];

    /// The names of all, as in settings.
    pub(crate) const NAMES: [&str; 2] =
        [Self::ALL[0].strategy().name, Self::ALL[1].strategy().name];

    /// What it does.
    #[doc(hidden)]
    pub const fn strategy(self) -> DensityStrategy {
        match self {
            Self::Conserving => DensityStrategy {
                name: "conserving",
                keeps_views: true,
                adds_pixels: true,
                gradient_threshold: 1.2e-3,
                spreads_growth: true,
                seeds_depths: true,
            },
            Self::Paper => DensityStrategy {
                name: "paper",
                keeps_views: false,
                adds_pixels: false,
                gradient_threshold: 2e-4,
                spreads_growth: false,
                seeds_depths: false,
            },
        }
    }
}

impl FromStr for DensityControl {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self, Error> {
        let is_named = |control: &Self| control.strategy().name == name;
        Self::ALL.into_iter().find(is_named).ok_or_else(|| {
            let known = Self::NAMES.join(" or ");
            Error::Usage(format!("unknown density control `{name}`; {known}"))
        })
    }
}
