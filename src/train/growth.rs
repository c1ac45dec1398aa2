//! Density control in a run: when it acts, and how many Gaussians it may leave.

use glam::UVec2;

use super::{TrainConfig, Trainer, streams};
use crate::Result;
use crate::densify::{DensifySettings, DensityControl, Round};
use crate::random::Stream;

impl Trainer {
    /// Density control acts after this step. Never so late that the run ends before what it added has settled.
    pub(super) fn densifies_at(&self, step: u64) -> bool {
        let schedule = &self.config.schedule;
        schedule.densifies_at(step) && step + schedule.densify_interval <= self.config.steps
    }

    /// Density control, behind the last step that was submitted.
    pub(super) fn control_density(&mut self) -> Result<()> {
        let gpu = self.gpu.clone();
        let rounds_left = match self.config.density.control {
            DensityControl::Conserving => self.config.schedule.rounds_left(self.step),
            DensityControl::Paper => 1,
        };
        let grown = self.growth_limit()?.max(self.model.count());
        let most = self.most_gaussians()?.min(grown);
        let round = Round { step: self.step, rounds_left, most };
        let changed = self.model.densify(&gpu, &mut self.densifier, round)?;
        tracing::debug!("step {}: {changed:?}", self.step);
        self.reserve()
    }

    /// How many Gaussians leave the device able to bind the intersections of a view, should it have twice as many of them for
    /// each Gaussian as the last one has; at least as many as there are.
    fn most_gaussians(&self) -> Result<usize> {
        let pixels = |size: UVec2| f64::from(size.x) * f64::from(size.y);
        let largest = self.views.sizes().into_iter().map(pixels).fold(0.0, f64::max);
        let shrunk = largest / pixels(self.view_of(self.step).size());
        let met = 2.0 * shrunk * f64::from(self.renderer.intersections()?.max(1));
        let count = self.model.count();
        let growth = f64::from(self.renderer.most_intersections()) / met;
        Ok(((count as f64 * growth) as usize).max(count))
    }
}

/// Density control in world units.
pub(super) fn settings(config: &TrainConfig, extent: f64) -> DensifySettings {
    DensifySettings {
        control: config.density.control,
        gradient_threshold: config.density.gradient_threshold,
        split_scale: config.density.split_scale * extent,
        min_opacity: config.density.min_opacity,
        max_gaussians: config.max_gaussians,
        seed: Stream::new(config.seed, streams::DENSITY).bits(0),
    }
}
