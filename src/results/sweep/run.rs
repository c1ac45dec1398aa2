//! A run of a sweep: its point and its run directory.

use std::path::{Path, PathBuf};

use nightsplat_photographs::dataset::{Dataset, View, ViewPictures};
use nightsplat_photographs::image::Image;
use serde_json::{Value, json};

use super::point::{RENDERS, SweepPoint};
use crate::Result;
use crate::gpu::Gpu;
use crate::results::eval::ModelRenderer;
use crate::results::run;
use crate::splats::model::Model;

/// The file of a run with the scores that a training does not take: values by the key of their measure, as in
/// `metrics.json`.
pub const LPIPS_FILE: &str = "lpips.json";

/// The run of a point.
#[derive(Clone, Debug)]
pub struct SweepRun {
    pub name: String,
    pub point: SweepPoint,
    pub folder: PathBuf,
}

/// A point that failed.
#[derive(Clone, Debug)]
pub struct FailedPoint {
    /// The point's name.
    pub name: String,
    /// Last error of its process.
    pub reason: String,
}

impl SweepRun {
    /// `metrics.json`, with the scores that were measured later, if the run is finished.
    pub fn metrics(&self) -> Option<Value> {
        let text = std::fs::read(self.folder.join("metrics.json")).ok()?;
        let mut metrics: Value = serde_json::from_slice(&text).ok()?;
        for (key, value) in measured_later(&self.folder)["mean"].as_object().into_iter().flatten() {
            metrics["mean"][key] = value.clone();
        }
        Some(metrics)
    }

    /// Renders a test view with the model of the finished run, or loads it from the renders of another program.
    pub fn render(&self, gpu: &Gpu, dataset: &Dataset, view: &View) -> Result<Image> {
        if let Some(folder) = self.metrics().unwrap_or_default()[RENDERS].as_str() {
            return ViewPictures::of_tests(Path::new(folder), dataset)?.load(view);
        }
        let config = run::load_config(&self.folder)?;
        let model = Model::load(&self.folder)?;
        let networks =
            run::load_networks(gpu, &self.folder, &config.model, model.gaussians.shape.features)?;
        let mut model_renderer = ModelRenderer::new(gpu, &model, &config, networks)?;
        model_renderer.light_as(&self.folder, 1.0)?;
        Ok(model_renderer.render(view)?.output().clone())
    }
}

/// The contents of [`LPIPS_FILE`] in a run directory; empty without it.
pub fn measured_later(folder: &Path) -> Value {
    let text = std::fs::read(folder.join(LPIPS_FILE)).ok();
    let metrics = text.and_then(|text| serde_json::from_slice(&text).ok());
    metrics.unwrap_or_else(|| json!({ "mean": {}, "views": {} }))
}
