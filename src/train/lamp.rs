//! A lamp that moves with the camera: where its learning begins, and its steps.

use std::collections::BTreeMap;

use glam::DVec3;
use nightsplat_photographs::dataset::{Dataset, Point, View};

use super::config::{LampRates, TrainConfig};
use super::encoding::LampToneLaw;
use crate::Result;
use crate::gpu::{Gpu, Recorder, Slice, SliceMut};
use crate::kernels::lamp::LAMP_WIDTH;
use crate::splats::lamp::Lamp;
use crate::splats::optimizer::{Adam, AdamBuffers, Learnable, Moments};
use crate::splats::render::{DeviceLamp, Renderer};
use crate::targets::Targets;

/// The most points whose distances are measured.
const MAX_POINTS: usize = 20_000;
/// The least falloff that learning begins from: near 0 its gradient is proportional to it.
const LEAST_FALLOFF: f64 = 0.05;
/// Of views that tell their exposures from a lamp: distances that differ by a tenth.
const LEAST_SPREAD: f64 = 0.1;
/// Fewer views show hardly any surface at two distances.
const FEWEST_VIEWS: usize = 3;

/// The state of the learning of a lamp's numbers.
#[derive(Debug)]
pub(super) struct LampLearning {
    rates: LampRates,
    pub(super) moments: Moments,
}

impl LampLearning {
    pub(super) fn new(gpu: &Gpu, rates: LampRates) -> Result<Self> {
        Ok(Self { rates, moments: Moments::zeros(gpu, LAMP_WIDTH as usize)? })
    }
}

/// The learned numbers of a lamp.
struct LearnedLamp<'a> {
    numbers: SliceMut<'a, f32>,
    gradients: Slice<'a, f32>,
    learning: &'a mut LampLearning,
}

impl Learnable for LearnedLamp<'_> {
    fn name(&self) -> &'static str {
        LEARNED
    }

    fn learning_rate(&self, step: u64) -> f64 {
        self.learning.rates.at(step)
    }

    fn buffers(&mut self) -> AdamBuffers<'_> {
        AdamBuffers {
            parameters: self.numbers.reborrow(),
            gradients: self.gradients,
            moments: self.learning.moments.slice_mut(),
        }
    }
}

/// The prefix of its tensors in a checkpoint.
pub(super) const LEARNED: &str = "lamp";

impl LampLearning {
    /// Records a step of the renderer's lamp.
    pub(super) fn update(
        &mut self,
        adam: &Adam,
        pass: &mut Recorder<'_>,
        renderer: &mut Renderer,
        step: u64,
        factor: f64,
    ) -> Result<()> {
        let Some((lamp, status)) = renderer.lamp_and_status() else { return Ok(()) };
        // The gradients of the first steps, whose colours are not settled, would be Adam's measure of later ones.
        let Some(step) = step.checked_sub(self.rates.after).filter(|&step| step > 0) else {
            return Ok(());
        };
        let DeviceLamp { numbers, gradients, .. } = lamp;
        let mut learned = LearnedLamp {
            numbers: numbers.slice_mut().range(0..LAMP_WIDTH as usize)?,
            gradients: gradients.slice(),
            learning: self,
        };
        adam.update(pass, step, factor, &mut learned, status)
    }
}

/// The lamp of the first step, in the training frame: that of the configuration at the median distance of what the
/// views show, with the tone curve of the photographs. The unit of light is that on the median of the points.
pub(super) fn start(targets: &Targets, dataset: &Dataset, config: &TrainConfig) -> Result<Lamp> {
    let views = dataset.train_views().count();
    if views < FEWEST_VIEWS {
        tracing::warn!(
            "{views} training views do not tell a lamp from the surfaces that it lights; without the part lamp, all \
             light is the surfaces'"
        );
    }
    if !config.tone.scene_statistics && config.tone.takes_exposure() {
        tracing::warn!(
            "every photograph has a gain of its own, which follows the lamp: set tone.scene_statistics to true"
        );
    }
    let scale = config.frame.unwrap_or_default().scale;
    let points = in_views(dataset);
    let distances_of_points =
        points.values().map(|points| points.iter().map(|point| point.length()).collect());
    let distances: Vec<Vec<f64>> = distances_of_points.collect();
    if config.exposure.learn && spread(&distances) < LEAST_SPREAD {
        tracing::warn!(
            "all views are at about the same distance from what they show: exposures of views can take the lamp's \
             place; --exposure off leaves it the light"
        );
    }
    let all = distances.into_iter().flatten().collect();
    let reference_distance = median(all).unwrap_or_else(|| config.extent_of(dataset));
    let LampToneLaw { black, slope, reach } = LampToneLaw::measured(targets)?;
    let lamp = Lamp {
        ambient: config.lamp.ambient,
        exponent: config.lamp.exponent,
        falloffs: [config.lamp.falloff, config.lamp.falloff_squared].map(|x| x.max(LEAST_FALLOFF)),
        reference_distance,
        slope,
        black,
        reach,
        ..Lamp::AT_CAMERA
    };
    let lights = points.values().flatten().map(|point| lamp.light(*point)).collect();
    let lamp = median(lights).map_or(lamp, |light| lamp.in_units_of(light));
    let reference_distance = lamp.reference_distance;
    tracing::info!(
        "a lamp at the camera: reference distance {reference_distance:.3}, slope of the tone curve {slope:.3}, which \
         saturates at {reach:.3}"
    );
    Ok(lamp.scaled(scale))
}

/// The points in view space of the training cameras that triangulated them, by the index of the view; if the dataset
/// does not list these, of those that see them.
fn in_views(dataset: &Dataset) -> BTreeMap<usize, Vec<DVec3>> {
    let Dataset { views, points, .. } = dataset;
    let has_tracks = points.iter().any(|point| !point.views.is_empty());
    let is_seen = |point: &Point, (index, view): (usize, &View)| match has_tracks {
        true => point.views.binary_search(&(index as u32)).is_ok(),
        false => view.camera.sees(point.position).is_some(),
    };
    let stride = points.len().div_ceil(MAX_POINTS).max(1);
    let mut in_views = BTreeMap::<usize, Vec<DVec3>>::new();
    for point in points.iter().step_by(stride) {
        let training = views.iter().enumerate().filter(|(_, view)| view.is_train());
        for (index, view) in training.filter(|view| is_seen(point, *view)) {
            let in_view = view.camera.view_from_world.transform_point3(point.position);
            in_views.entry(index).or_default().push(in_view);
        }
    }
    in_views
}

/// The standard deviation of the logarithm of the views' median distances.
fn spread(distances: &[Vec<f64>]) -> f64 {
    let logarithms =
        distances.iter().filter_map(|logarithms| Some(median(logarithms.clone())?.ln()));
    let logarithms: Vec<f64> = logarithms.collect();
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
    let middle = mean(&logarithms);
    mean(&logarithms.iter().map(|value| (value - middle).powi(2)).collect::<Vec<_>>()).sqrt()
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.retain(|value| value.is_normal() && *value > 0.0);
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
