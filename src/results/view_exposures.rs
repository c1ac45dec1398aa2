//! Renders of training views at the exposure of their targets.

use std::collections::BTreeMap;
use std::path::Path;

use nightsplat_photographs::image::Image;
use nightsplat_photographs::tone::exposure_knots;

use super::run;
use crate::{Error, Result};
use nightsplat_photographs::exposures::Affine;

/// The exposures of the training views relative to that of the model.
pub(crate) enum ViewExposures {
    /// Learned gain and bias per view.
    Learned(BTreeMap<String, Affine>),
    /// Gains of the targets.
    OfTargets(run::RecordedExposure),
}

impl ViewExposures {
    pub(crate) fn load(run: &Path) -> Result<Self> {
        let learned = run::load_exposures(run)?;
        if !learned.is_empty() {
            return Ok(Self::Learned(learned));
        }
        if let Some(exposure) = run::load_target_exposure(run) {
            return Ok(Self::OfTargets(exposure));
        }
        let problem = "has one exposure for all targets; leave out --view-exposure";
        Err(Error::input(run, problem))
    }

    /// Changes a render of `view` from the model's exposure to that of the view's target.
    pub(crate) fn applied(&self, view: &str, mut image: Image) -> Image {
        let exposure = match self {
            Self::Learned(exposures) => {
                let affine = exposures.get(view);
                return affine.map_or(image.clone(), |affine| affine.applied(&image));
            }
            Self::OfTargets(exposure) => exposure,
        };
        let Some(gain) = exposure.gains.get(view) else { return image };
        let weight = exposure.scene.weight.unwrap_or(1.0);
        let knots = exposure_knots(&exposure.scene.ends, [exposure.model_gain, *gain], weight);
        for x in &mut image.data {
            let inside = x.clamp(knots[0][0], knots[knots.len() - 1][0]);
            let above = knots.partition_point(|knot| knot[0] <= inside).clamp(1, knots.len() - 1);
            let [[x0, y0], [x1, y1]] = [knots[above - 1], knots[above]];
            let y = y0 + (inside - x0) / (x1 - x0).max(f32::MIN_POSITIVE) * (y1 - y0);
            *x = y + (*x - inside);
        }
        image
    }
}
