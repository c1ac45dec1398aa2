//! Summary of a run, printed before its first step.

use nightsplat_core::output::one_line;
use nightsplat_photographs::dataset::{Dataset, Split, View};
use nightsplat_photographs::tone::{Tone, ToneCurve};
use serde::Serialize;

use super::eval::{ReferenceKind, ScoreReference};
use crate::gpu::Gpu;
use crate::train::TrainConfig;
use crate::train::plan::Plan;

/// Dataset, device, views, split, points and curve of a run.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct RunFacts {
    dataset: String,
    device: String,
    /// Width and height of the first training view, pixels.
    size: [u32; 2],
    train_views: usize,
    /// Test views with an image to score them against.
    test_views: usize,
    /// Views held out for early stopping.
    held_out_views: usize,
    /// Maximum number of steps.
    steps: u64,
    /// Length of the cooldown, steps.
    effective_cooldown_steps: u64,
    /// Requests on the length of the run that cannot be met.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    notes: Vec<String>,
    /// The rule that selects the test views.
    split: String,
    points: usize,
    curve: String,
    why: String,
    /// The images that test views are scored against.
    against: &'static str,
}

impl RunFacts {
    pub(crate) fn new(
        gpu: &Gpu,
        config: &TrainConfig,
        plan: Option<&Plan>,
        dataset: &Dataset,
    ) -> Self {
        let of = |split| dataset.views.iter().filter(|view| view.split == split).count();
        let first = dataset.train_views().next();
        let planned = plan.map(|plan| plan.curve.why.clone());
        let why = match &config.tone.curve {
            Tone::Formula(ToneCurve::None) if planned.is_none() => {
                "as requested: the photographs are the targets"
            }
            Tone::Auto => "brightness chosen from the photographs",
            Tone::External(_) => "as requested: no curve and no tone law",
            Tone::Formula(ToneCurve::None) => "",
            _ => "as requested",
        };
        let against = ScoreReference::kind(&config.tone, dataset);
        let is_scored = |view: &View| match against {
            ReferenceKind::References => view.has_reference(),
            _ => view.has_photograph(),
        };
        Self {
            dataset: config.dataset.display().to_string(),
            device: gpu.properties().name.clone(),
            size: first.map_or([0; 2], |view| [view.camera.width, view.camera.height]),
            train_views: of(Split::Train),
            test_views: dataset.test_views().filter(|view| is_scored(view)).count(),
            held_out_views: of(Split::HeldOut),
            steps: config.steps,
            effective_cooldown_steps: config.effective_cooldown_steps(),
            notes: notes(config, dataset),
            split: Dataset::split_rule(&config.dataset, &config.load_options(), of(Split::Test)),
            points: dataset.points.len(),
            curve: config.tone.curve.to_string(),
            why: match planned {
                Some(planned) if why.is_empty() => planned,
                _ => why.to_owned(),
            },
            against: against.name(),
        }
    }

    pub(crate) fn text(&self) -> String {
        let Self { dataset, device, size: [width, height], train_views, points, .. } = self;
        let length = match (self.held_out_views, self.effective_cooldown_steps) {
            (0, 0) => format!("{} steps", self.steps),
            (0, settling) => {
                format!("{} steps, the last {settling} are the cooldown", self.steps)
            }
            (views, settling) => format!(
                "at most {} steps: training stops early once {views} held-out view{} converged, after a \
                 cooldown of {settling}",
                self.steps,
                if views == 1 { " has" } else { "s have" }
            ),
        };
        let notes: String = self.notes.iter().map(|note| format!("{note}\n")).collect();
        let tests = match self.test_views {
            0 => format!("0 test views ({})", self.split),
            count => format!("{count} test views ({}) scored against {}", self.split, self.against),
        };
        let dataset = one_line(dataset);
        format!(
            "{dataset}: {train_views} views of {width}x{height} to train on; {tests}; {points} points; on {device}\n\
             {length}\n{notes}curve {}: {}\n",
            self.curve, self.why
        )
    }
}

/// A line for each request on the length of the run that cannot be met.
fn notes(config: &TrainConfig, dataset: &Dataset) -> Vec<String> {
    let (steps, asked) = (config.steps, config.schedule.cooldown_steps);
    let views = dataset.views.iter().filter(|view| view.is_for_training()).count();
    let is_held_out = dataset.views.iter().any(|view| view.split == Split::HeldOut);
    let none = (config.stop.views > 0 && !is_held_out).then(|| {
        format!(
            "no early stopping: {views} training views are too few to hold one out (one in eight)"
        )
    });
    let short = (config.effective_cooldown_steps() < asked)
        .then(|| format!("{steps} steps are too few for a cooldown of {asked} (at most a third)"));
    none.into_iter().chain(short).collect()
}
