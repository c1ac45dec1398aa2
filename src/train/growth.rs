//! Density control in a run: its steps, and the limits of growth.

use glam::UVec2;
use nightsplat_core::camera::Camera;
use nightsplat_core::random::Stream;
use nightsplat_photographs::dataset::Dataset;

use super::memory::MARGIN;
use super::rendered::Rendered;
use super::target_views::TargetViews;
use super::{TrainConfig, Trainer, streams};
use crate::Result;
use crate::gpu::Gpu;
use crate::splats::densify::{Densifier, DensifyReport, DensifySettings, DensityControl, Round};
use crate::splats::render::RenderOptions;
use crate::splats::scene::GaussianSlice;

/// The most dB that a round may cost on the probes before it is repeated with fewer splits. The training views as a
/// whole may lose somewhat more.
const MAX_LOST: f64 = 0.2;

/// The state of density control.
#[derive(Debug)]
pub(super) struct Growth {
    pub(super) densifier: Densifier,
    /// Training views on which the cost of a round is measured; empty if it is not.
    pub(super) probes: TargetViews,
    /// Whether the end of growth for lack of capacity was logged.
    pub(super) has_logged_capacity: bool,
}

impl Trainer {
    /// Whether density control acts after this step: not in the cooldown, nor within the last interval of the run.
    pub(super) fn densifies_at(&self, step: u64) -> bool {
        let schedule = &self.config.schedule;
        let is_in_time = step + schedule.densify_interval <= self.config.steps;
        schedule.densifies_at(step)
            && is_in_time
            && step <= self.cooldown_begin()
            && !self.config.freezes_geometry()
    }

    /// Density control after the last step, whose view had this many intersections.
    pub(super) fn control_density(&mut self, intersections: u32) -> Result<()> {
        let _phase = tracing::info_span!("density control").entered();
        let rounds_left = match self.config.density.control {
            DensityControl::Conserving => {
                self.config.schedule.rounds_left(self.step, self.cooldown_begin())
            }
            DensityControl::Paper => 1,
        };
        let grown = self.growth_limit()?.max(self.model.count());
        let (capacity, why) = self.capacity(intersections);
        let most = capacity.min(grown);
        if self.seeds_at(self.step) {
            self.seed_depths(self.seeded_count().min(most))?;
            self.convergence.decisions.density_due = None;
            return self.reserve();
        }
        let round = Round { step: self.step, rounds_left, most };
        let report = self.densify(round)?;
        self.convergence.decisions.density_due = None;
        if report.refused > 0
            && capacity < self.config.max_gaussians
            && !self.growth.has_logged_capacity
        {
            self.growth.has_logged_capacity = true;
            tracing::warn!("growth stops at {capacity} Gaussians, {why}");
        }
        self.reserve()
    }

    /// A round of density control with as many splits as the probes allow.
    fn densify(&mut self, round: Round) -> Result<DensifyReport> {
        let options = RenderOptions { sh_degree: self.sh_degree(self.step), background: [0.0; 3] };
        let affines = self.affines()?;
        let Self { gpu, model, renderer, growth: Growth { densifier, probes, .. }, .. } = self;
        let mut psnr = |gaussians: GaussianSlice<'_>| {
            let show = |camera: &Camera| Rendered::new(renderer, gaussians, camera, &options, None);
            Ok(probes.mean_psnr(&affines, show)?.map_or(0.0, |[colors, _]| colors))
        };
        let before = psnr(model.gaussians.slice())?;
        let mut after = before;
        let report = model.densify(gpu, densifier, round, |new| {
            after = psnr(new)?;
            Ok(share_that_stays(before - after))
        })?;
        tracing::debug!("step {}: {report:?}; probes {before:.3} -> {after:.3} dB", round.step);
        Ok(report)
    }

    /// The largest number of Gaussians that fits, at least the present number, and the limiting resource. A view may
    /// have twice as many intersections per Gaussian as the last one.
    fn capacity(&self, intersections: u32) -> (usize, &'static str) {
        let pixels = |size: UVec2| f64::from(size.x) * f64::from(size.y);
        let largest = self.supervision.views.sizes().into_iter().map(pixels).fold(0.0, f64::max);
        let shrunk = largest / pixels(self.view_of(self.step).size());
        let met = MARGIN * shrunk * f64::from(intersections.max(1));
        let count = self.model.count();
        let each = met / count.max(1) as f64;
        let bindable = f64::from(self.renderer.max_intersections()) / each;
        let bindable = self.max_renderable().min(bindable as usize);
        let bounds = [
            (bindable, "the most that the device binds"),
            (self.fitting_in_vram(each), "the most that fits in max_vram"),
            (self.fitting_in_ram(each), "the most that fits in max_ram"),
        ];
        let (capacity, why) =
            bounds.into_iter().min_by_key(|(capacity, _)| *capacity).unwrap_or(bounds[0]);
        (capacity.max(count), why)
    }

    /// The limit of Gaussians from the setting and from the buffers that the renderer binds.
    pub(super) fn max_renderable(&self) -> usize {
        let renderable = self.config.render_settings().peak_gaussians(&self.gpu);
        self.config.max_gaussians.min(renderable)
    }
}

/// The share of a round's splits to keep if all of them cost `lost` dB. The cost grows with the square root of the
/// share, since the splits with the largest gradients cost most; a margin of a tenth is included.
fn share_that_stays(lost: f64) -> f64 {
    if lost > MAX_LOST { (0.9 * MAX_LOST / lost).powi(2) } else { 1.0 }
}

/// Density control in the frame, for the cameras of the training views.
pub(super) fn densifier(gpu: &Gpu, config: &TrainConfig, dataset: &Dataset) -> Result<Densifier> {
    let frame = config.frame.unwrap_or_default();
    let cameras = dataset.train_views().map(|view| frame.camera(&view.camera));
    let settings = DensifySettings {
        control: config.density.control,
        gradient_threshold: config.density.gradient_threshold,
        split_scale: config.density.split_scale * config.extent_of(dataset) * frame.scale,
        min_opacity: config.density.min_opacity,
        max_gaussians: config.max_gaussians,
        near: config.render_settings().near.into(),
        seed: Stream::new(config.seed, streams::DENSITY).bits(0),
    };
    Densifier::new(gpu, settings, &cameras.collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use super::*;
    use crate::gpu::testing::gpu;
    use crate::targets::Targets;
    use crate::train::Preset;
    use crate::train::target_views::TargetViews;
    use nightsplat_synth::SyntheticOptions;

    /// The most dB that a round may cost the training views.
    const BOUND: f64 = 0.3;

    /// The cost of each round of a run on all training views, in dB, by step.
    fn losses(config: &TrainConfig) -> Vec<(u64, f64)> {
        let gpu = gpu();
        let dataset = Dataset::load(&config.dataset, &config.load_options()).unwrap();
        let frame = dataset.frame();
        let targets = Targets::new(&gpu, &config.tone, &dataset).unwrap();
        let all = [usize::MAX; 2];
        let views = TargetViews::probes(&targets, &dataset, &frame, all).unwrap();
        let mut trainer = Trainer::new(&gpu, config.clone(), &dataset).unwrap();
        let psnr = |trainer: &mut Trainer| {
            let (degree, affines) = (trainer.sh_degree_in_use(), trainer.affines().unwrap());
            let show = |camera: &Camera| trainer.render_of_degree(camera, degree);
            let [colors, _] = views.mean_psnr(&affines, show).unwrap().unwrap();
            colors
        };
        let mut losses = vec![];
        while !trainer.has_ended() {
            trainer.train_steps(config.steps, &mut vec![]).unwrap();
            let is_round = trainer.convergence.decisions.density_due.is_some();
            let before = is_round.then(|| psnr(&mut trainer));
            trainer.control().unwrap();
            losses.extend(before.map(|before| (trainer.step, before - psnr(&mut trainer))));
        }
        losses
    }

    fn worst(config: &TrainConfig) -> (u64, f64) {
        let losses = losses(config);
        assert!(losses.len() > 3, "{losses:?}");
        losses.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap()
    }

    fn growth_config(preset: Preset, dataset: &Path, seed: u64) -> TrainConfig {
        let mut config =
            TrainConfig { dataset: dataset.to_owned(), seed, ..TrainConfig::default() };
        preset.apply(&mut config).unwrap();
        config
    }

    #[test]
    fn no_round_costs_the_training_views_more_than_the_bound() {
        for seed in 1..=3 {
            let folder = tempfile::tempdir().unwrap();
            let options = SyntheticOptions {
                views: 12,
                width: 64,
                height: 48,
                seed,
                ..SyntheticOptions::default()
            };
            nightsplat_synth::write(folder.path(), &options).unwrap();
            let mut config = growth_config(Preset::Fast, folder.path(), seed);
            config.schedule.densify_interval = 50;
            let (step, lost) = worst(&config);
            assert!(lost <= BOUND, "seed {seed}, step {step}: {lost} dB");
        }
    }

    /// The scenes that `NIGHTSPLAT_SCENES` names, at full, half and quarter size, with three seeds.
    #[test]
    #[ignore = "takes hours: `scripts/stress.py growth`"]
    fn no_round_of_a_real_scene_costs_the_training_views_more_than_the_bound() {
        let scenes = std::env::var("NIGHTSPLAT_SCENES").expect("NIGHTSPLAT_SCENES names scenes");
        let sizes = std::env::var("NIGHTSPLAT_DOWNSCALES").unwrap_or_else(|_| "4,2,1".to_owned());
        let seeds = std::env::var("NIGHTSPLAT_SEEDS").unwrap_or_else(|_| "1,2,3".to_owned());
        let mut failed = vec![];
        for scene in scenes.split(',').map(PathBuf::from) {
            for downscale in sizes.split(',').map(|size| size.parse().unwrap()) {
                for seed in seeds.split(',').map(|seed| seed.parse().unwrap()) {
                    let config =
                        TrainConfig { downscale, ..growth_config(Preset::Balanced, &scene, seed) };
                    let (step, lost) = worst(&config);
                    let line = format!(
                        "{} / {downscale}, seed {seed}: {lost:.3} dB at step {step}",
                        scene.display()
                    );
                    println!("{line}");
                    if lost > BOUND {
                        failed.push(line);
                    }
                }
            }
        }
        assert!(failed.is_empty(), "{failed:#?}");
    }
}
