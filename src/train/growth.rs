//! Density control in a run: when it acts, and how many Gaussians it may leave.

use glam::UVec2;

use super::memory::MARGIN;
use super::{TrainConfig, Trainer, streams};
use crate::Result;
use crate::dataset::Dataset;
use crate::densify::{Densifier, DensifySettings, DensityControl, Round};
use crate::gpu::Gpu;
use crate::random::Stream;

impl Trainer {
    /// Density control acts after this step. Never so late that the run ends before what it added has settled.
    pub(super) fn densifies_at(&self, step: u64) -> bool {
        let schedule = &self.config.schedule;
        schedule.densifies_at(step) && step + schedule.densify_interval <= self.config.steps
    }

    /// Density control behind the last step, whose view had so many intersections.
    pub(super) fn control_density(&mut self, intersections: u32) -> Result<()> {
        let gpu = self.gpu.clone();
        let rounds_left = match self.config.density.control {
            DensityControl::Conserving => self.config.schedule.rounds_left(self.step),
            DensityControl::Paper => 1,
        };
        let grown = self.growth_limit()?.max(self.model.count());
        let (room, why) = self.room(intersections);
        let most = room.min(grown);
        if self.fills_at(self.step) {
            self.fill(self.filled_count().min(most))?;
            self.ends.density_due = None;
            return self.reserve();
        }
        let round = Round { step: self.step, rounds_left, most };
        let report = self.model.densify(&gpu, &mut self.densifier, round)?;
        self.ends.density_due = None;
        tracing::debug!("step {}: {report:?}", self.step);
        if report.refused > 0 && room < self.config.max_gaussians && !self.has_said_room {
            self.has_said_room = true;
            tracing::warn!("growth stops at {room} Gaussians, {why}");
        }
        self.reserve()
    }

    /// How many Gaussians there is room for, at least as many as there are, and what there is no more of. A view may have
    /// twice as many intersections for each Gaussian as the last one had.
    fn room(&self, intersections: u32) -> (usize, &'static str) {
        let pixels = |size: UVec2| f64::from(size.x) * f64::from(size.y);
        let largest = self.views.sizes().into_iter().map(pixels).fold(0.0, f64::max);
        let shrunk = largest / pixels(self.view_of(self.step).size());
        let met = MARGIN * shrunk * f64::from(intersections.max(1));
        let count = self.model.count();
        let each = met / count.max(1) as f64;
        let bindable = f64::from(self.renderer.most_intersections()) / each;
        let bindable = self.most_renderable().min(bindable as usize);
        let bounds = [
            (bindable, "all that the device can bind at once"),
            (self.fitting_in_vram(each), "all that fits into max_vram"),
            (self.fitting_in_ram(each), "all that fits into max_ram"),
        ];
        let (room, why) = bounds.into_iter().min_by_key(|(room, _)| *room).unwrap_or(bounds[0]);
        (room.max(count), why)
    }

    /// The most Gaussians there may be, by the setting and by what passes of the renderer bind.
    pub(super) fn most_renderable(&self) -> usize {
        let renderable = self.config.render_settings().most_gaussians(&self.gpu);
        self.config.max_gaussians.min(renderable)
    }
}

/// Density control in the frame, for the cameras of the training views.
///
/// # Errors
/// A setting makes no sense, or the device refuses a pipeline.
pub(super) fn densifier(gpu: &Gpu, config: &TrainConfig, dataset: &Dataset) -> Result<Densifier> {
    let frame = config.frame.unwrap_or_default();
    let cameras = dataset.train_views().map(|view| frame.from_world(view.camera.center()));
    let settings = DensifySettings {
        control: config.density.control,
        gradient_threshold: config.density.gradient_threshold,
        split_scale: config.density.split_scale * dataset.extent() * frame.scale,
        min_opacity: config.density.min_opacity,
        max_gaussians: config.max_gaussians,
        seed: Stream::new(config.seed, streams::DENSITY).bits(0),
    };
    Densifier::new(gpu, settings, &cameras.collect::<Vec<_>>())
}
