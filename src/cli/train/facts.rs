//! What a run begins with: what is said of it before the first step.

use serde::Serialize;

use crate::dataset::{Dataset, Split};
use crate::diagnose::Plan;
use crate::eval::Yardstick;
use crate::gpu::Gpu;
use crate::tone::ToneCurve;
use crate::train::TrainConfig;

/// Device, views, split, points and curve.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Facts {
    dataset: String,
    device: String,
    /// Width and height of the first training view, pixels.
    size: [u32; 2],
    train_views: usize,
    test_views: usize,
    /// Views that are kept from training to tell when it has converged.
    held_out_views: usize,
    /// What says which views are test views.
    split: String,
    points: usize,
    curve: String,
    why: String,
    /// What the test views are scored against.
    against: &'static str,
}

impl Facts {
    pub(super) fn of(
        gpu: &Gpu,
        config: &TrainConfig,
        plan: Option<&Plan>,
        dataset: &Dataset,
    ) -> Self {
        let of = |split| dataset.views.iter().filter(|view| view.split == split).count();
        let first = dataset.train_views().next();
        let planned = plan.map(|plan| plan.curve.why.clone());
        let why = match config.tone.curve {
            ToneCurve::None if planned.is_none() => "as asked for: the photographs are the targets",
            ToneCurve::Auto => "as bright as the photographs ask for",
            ToneCurve::None => "",
            _ => "as asked for",
        };
        Self {
            dataset: config.dataset.display().to_string(),
            device: gpu.properties().name.clone(),
            size: first.map_or([0; 2], |view| [view.camera.width, view.camera.height]),
            train_views: of(Split::Train),
            test_views: of(Split::Test),
            held_out_views: of(Split::HeldOut),
            split: Dataset::split_rule(&config.dataset, &config.load_options()),
            points: dataset.points.len(),
            curve: config.tone.curve.name().to_owned(),
            why: match planned {
                Some(planned) if why.is_empty() => planned,
                _ => why.to_owned(),
            },
            against: Yardstick::kind(&config.tone, dataset).name(),
        }
    }

    pub(super) fn text(&self) -> String {
        let Self { dataset, device, size: [width, height], train_views, points, .. } = self;
        let held_out = match self.held_out_views {
            0 => String::new(),
            count => format!(", {count} kept from training to tell when it has converged"),
        };
        let tests = match self.test_views {
            0 => "no test view".to_owned(),
            count => format!("{count} test views ({}) scored against {}", self.split, self.against),
        };
        format!(
            "{dataset}: {train_views} views of {width}x{height} to train on{held_out}; {tests}; {points} points; on {device}\n\
             curve {}: {}\n",
            self.curve, self.why
        )
    }
}
