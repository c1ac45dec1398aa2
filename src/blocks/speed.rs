//! The time of a training step, measured on a few views of the scene.

use std::collections::BTreeSet;
use std::time::Instant;

use nightsplat_core::camera::Camera;
use nightsplat_photographs::dataset::View;

use crate::Result;
use crate::gpu::Gpu;
use crate::train::{PlannedRun, Trainer};

/// Views that are trained on: more would take more time to load, and none to measure.
const VIEWS: usize = 8;
/// The most points to start from: more would take memory that planning need not have.
const MAX_POINTS: usize = 100_000;
/// Steps before the measurement, in which memory is taken, and those that are measured.
const STEPS: [u64; 2] = [8, 32];

/// Milliseconds of a step at full size from the first Gaussians, and their number.
pub(crate) fn speed(gpu: &Gpu, planned: &PlannedRun) -> Result<(f64, usize)> {
    let mut dataset = planned.dataset.clone();
    let training: Vec<&View> = dataset.train_views().filter(|view| view.has_photograph()).collect();
    let cameras: Vec<Camera> = training.iter().map(|view| view.camera).collect();
    let kept: BTreeSet<usize> = Camera::covering(&cameras, VIEWS).into_iter().collect();
    let others = training.iter().enumerate().filter(|(index, _)| !kept.contains(index));
    let others: Vec<String> = others.map(|(_, view)| view.name.clone()).collect();
    dataset.leave_out(&others);
    let every = dataset.points.len().div_ceil(MAX_POINTS).max(1);
    dataset.points = dataset.points.into_iter().step_by(every).collect();
    let mut config = planned.config.clone();
    config.steps = STEPS.iter().sum();
    config.stop.views = 0;
    config.schedule.resolution_steps = Some([0, 0]);
    let mut trainer = Trainer::new(gpu, config, &dataset)?;
    while trainer.steps_done() < STEPS[0] {
        trainer.advance(STEPS[0])?;
    }
    let begin = Instant::now();
    while !trainer.has_ended() {
        trainer.advance(trainer.last_step())?;
    }
    let milliseconds = begin.elapsed().as_secs_f64() * 1e3 / STEPS[1] as f64;
    Ok((milliseconds, trainer.gaussian_count()))
}
