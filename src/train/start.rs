//! The model that a training begins with, where one is given.

use super::TrainConfig;
use crate::splats::scene::{FEATURES, Gaussians, Shape, ply};
use crate::{Error, Result};

impl TrainConfig {
    /// The Gaussians of [`TrainConfig::init`], made of what the configuration's model is; features that it lacks go.
    ///
    /// # Errors
    /// The file is no model, or one of a higher SH degree or without a feature that the configuration asks for.
    pub(super) fn initial_model(&self) -> Result<Option<Gaussians>> {
        let Some(path) = &self.init else { return Ok(None) };
        let mut gaussians = ply::load(path)?;
        let (Shape { sh_degree, features }, own) = (self.render_settings().shape, gaussians.shape);
        if own.sh_degree > sh_degree {
            let problem = format!(
                "has SH degree {}, more than the {sh_degree} of `TrainConfig::sh_degree`",
                own.sh_degree
            );
            return Err(Error::input(path, problem));
        }
        let lacks = |feature| features.has(feature) && !own.features.has(feature);
        if let Some(spec) = FEATURES.iter().find(|spec| lacks(spec.feature)) {
            let (property, name) = (spec.ply_name, spec.name);
            let problem = format!(
                "has no property `f_{property}_0`, which a model with {name} needs; train without that part"
            );
            return Err(Error::input(path, problem));
        }
        if self.model.raw_colors {
            gaussians.shift_colors(0.5);
        }
        Ok(Some(gaussians.with_features(features)))
    }

    /// The SH degree that is in use at a step, of at most `highest`.
    pub(super) fn sh_degree_at(&self, step: u64, highest: u32) -> u32 {
        // Without the degrees that a model has, the first steps would teach it to do without them.
        if self.init.is_some() { highest } else { self.schedule.sh_degree(step, highest) }
    }
}
