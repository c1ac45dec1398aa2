//! Renders of training views at the exposure of their targets.

use std::collections::BTreeMap;
use std::path::Path;

use super::run;
use crate::loss::exposure::Affine;
use crate::photographs::image::Image;
use crate::photographs::tone::exposed_anew;
use crate::{Error, Result};

/// The exposures of the training views relative to that of the model.
pub(crate) enum ViewExposures {
    /// Learned gain and bias per view.
    Learned(BTreeMap<String, Affine>),
    /// Gains of the targets.
    OfTargets(serde_json::Value),
}

impl ViewExposures {
    pub(crate) fn of(run: &Path) -> Result<Self> {
        let learned = run::load_exposures(run)?;
        if !learned.is_empty() {
            return Ok(Self::Learned(learned));
        }
        let exposure = run::load_metrics(run)[run::TARGET_EXPOSURE].take();
        if exposure["model_gain"].is_number() {
            return Ok(Self::OfTargets(exposure));
        }
        let problem = "has one exposure for all targets; leave out --view-exposure";
        Err(Error::input(run, problem))
    }

    /// Changes a render of `view` from the model's exposure to that of the view's target.
    pub(crate) fn applied(&self, view: &str, mut image: Image) -> Image {
        let number = |value: &serde_json::Value| value.as_f64();
        let exposure = match self {
            Self::Learned(exposures) => {
                let own = exposures.get(view);
                return own.map_or(image.clone(), |own| own.applied(&image));
            }
            Self::OfTargets(exposure) => exposure,
        };
        let gains = number(&exposure["model_gain"]).zip(number(&exposure["gains"][view]));
        let Some((from, to)) = gains else { return image };
        let knots = exposed_anew([from, to], number(&exposure["scene"]["weight"]).unwrap_or(1.0));
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
