//! Reads a run directory.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use nightsplat_core::{csv, input};
use nightsplat_models::gaussians::{Features, Gaussians, ply};
use nightsplat_models::joined::TileManifest;
use nightsplat_photographs::dataset::Dataset;
use nightsplat_photographs::tone::CurveEnds;

use super::directory::view_lines;
use super::files::{EXPOSURES, LAMP, NETWORKS, PLAN, TARGET_EXPOSURE, VIEWS};
use super::generations;
use crate::gpu::Gpu;
use crate::results::eval::ModelRenderer;
use crate::splats::lamp::Lamp;
use crate::train::{ModelConfig, Networks, TrainConfig};
use crate::{Error, Result};
use nightsplat_photographs::exposures::{Affine, table};

/// Whether a directory contains a finished run.
pub fn is_finished(run: &Path) -> bool {
    run.join("metrics.json").exists()
}

/// The contents of `metrics.json`; null if there is none.
pub fn load_metrics(run: &Path) -> serde_json::Value {
    let text = std::fs::read(run.join("metrics.json")).ok();
    text.and_then(|text| serde_json::from_slice(&text).ok()).unwrap_or_default()
}

/// The exposures of the targets, as `metrics.json` of a run has them.
#[derive(Clone, Debug, serde::Deserialize)]
pub(crate) struct RecordedExposure {
    /// The exposure at which the model renders.
    pub(crate) model_gain: f64,
    /// The gain of every training view, by name.
    #[serde(default)]
    pub(crate) gains: BTreeMap<String, f64>,
    #[serde(default)]
    pub(crate) scene: RecordedScene,
}

/// The exposure of the training photographs together.
#[derive(Clone, Debug, Default, serde::Deserialize)]
pub(crate) struct RecordedScene {
    /// The weight of the curve.
    pub(crate) weight: Option<f64>,
    #[serde(default)]
    pub(crate) ends: CurveEnds,
}

/// The exposures of the targets of a run; `None` if they are unknown.
pub(crate) fn load_target_exposure(run: &Path) -> Option<RecordedExposure> {
    serde_json::from_value(load_metrics(run)[TARGET_EXPOSURE].take()).ok()
}

/// The configuration of a finished or unfinished run.
///
/// # Errors
/// The directory contains none.
pub fn load_config(run: &Path) -> Result<TrainConfig> {
    let path = run.join("config.toml");
    if !path.is_file() {
        let problem = "is no run directory: it has no config.toml; name the folder that `nightsplat train` wrote";
        return Err(Error::input(run, problem));
    }
    Ok(TrainConfig::load(&path)?.with_paths_from(run))
}

/// The plan of a run, if it has one.
pub fn plan_of(run: &Path) -> Option<PathBuf> {
    Some(run.join(PLAN)).filter(|path| path.is_file())
}

/// The step of the model of an unfinished run; `None` if it is finished or the step is unknown.
pub fn stopped_at(run: &Path) -> Option<u64> {
    if is_finished(run) {
        return None;
    }
    // A safetensors file begins with the length of its header, JSON with the checkpoint's description.
    let mut file = File::open(generations::newest(run)?).ok()?;
    let mut length = [0; 8];
    file.read_exact(&mut length).ok()?;
    let mut header = String::new();
    file.take(u64::from_le_bytes(length)).read_to_string(&mut header).ok()?;
    let header: serde_json::Value = serde_json::from_str(&header).ok()?;
    let note = header["__metadata__"]["checkpoint"].as_str()?;
    serde_json::from_str::<serde_json::Value>(note).ok()?["step"].as_u64()
}

/// The trained Gaussians of a run, or those of the joined blocks of a scene, in the colours that viewers show.
pub fn load_gaussians(run: &Path) -> Result<Gaussians> {
    let path = run.join("model.ply");
    if let Some(manifest) = TileManifest::of_scene(run)? {
        return manifest.gaussians();
    }
    if !path.is_file() {
        let problem = "has no model.ply: the run neither finished nor reached a checkpoint; train it again, or \
                       continue with --resume";
        return Err(Error::input(run, problem));
    }
    ply::load(path)
}

/// The trained networks of a run; `None` if its model has none. `features` are those of its Gaussians: a part without
/// anything to learn from has none, whatever the configuration says.
///
/// # Errors
/// Their file is missing, damaged, or of another configuration.
pub fn load_networks(
    gpu: &Gpu,
    run: &Path,
    model: &ModelConfig,
    features: Features,
) -> Result<Option<Networks>> {
    if !model.denoiser && !model.tonemapper {
        return Ok(None);
    }
    let mut networks = Networks::new(gpu, model, features, 0)?;
    networks.load(&run.join(NETWORKS))?;
    Ok(Some(networks))
}

/// The learned lamp of a run, in units of its dataset's world; `None` if it has none.
pub fn load_lamp(run: &Path) -> Result<Option<Lamp>> {
    let path = run.join(LAMP);
    if !path.is_file() {
        return Ok(None);
    }
    let refused = |problem: String| Error::input(&path, format!("is not a lamp: {problem}"));
    let text = input::text(&path)?;
    let lamp: Lamp = serde_json::from_str(&text).map_err(|error| refused(error.to_string()))?;
    lamp.check().map_err(|error| refused(error.to_string()))?;
    Ok(Some(lamp))
}

impl ModelRenderer {
    /// Lights what is rendered from now on as the photographs of a run were, by its lamp, if it has one; whether it
    /// has. A unit of the run's world is `units` of the model's.
    pub(crate) fn light_as(&mut self, run: &Path, units: f64) -> Result<bool> {
        let lamp = load_lamp(run)?;
        self.set_lamp(lamp.map(|lamp| lamp.scaled(units)))?;
        Ok(lamp.is_some())
    }
}

/// The learned exposures of a run's training views relative to its model, by name; empty if none were learned.
pub fn load_exposures(run: &Path) -> Result<BTreeMap<String, Affine>> {
    let path = run.join(EXPOSURES);
    let exposures = if path.is_file() { table::load(&path)? } else { vec![] };
    Ok(exposures
        .into_iter()
        .filter_map(|exposures| Some((exposures.name, exposures.affine?)))
        .collect())
}

/// The difference between the views of a dataset and those of a run, in words; `None` if they are equal, or the run has
/// no list of views.
pub fn other_views(run: &Path, dataset: &Dataset) -> Option<String> {
    let text = std::fs::read_to_string(run.join(VIEWS)).ok()?;
    let views: BTreeSet<String> =
        text.lines().skip(1).map(|line| csv::line(csv::cells_of(line, 4))).collect();
    let others: BTreeSet<String> = view_lines(dataset).into_iter().collect();
    let [gone, new] = [views.difference(&others), others.difference(&views)].map(|lines| {
        let lines: Vec<&str> = lines.map(|line| line.trim_end()).collect();
        lines.first().map(|first| format!("{} (the first: {first})", lines.len()))
    });
    match (gone, new) {
        (None, None) => None,
        (Some(gone), Some(new)) => {
            Some(format!("{gone} views of the run are not in it, {new} are new"))
        }
        (Some(gone), None) => Some(format!("{gone} views of the run are not in it")),
        (None, Some(new)) => Some(format!("{new} views are new")),
    }
}
