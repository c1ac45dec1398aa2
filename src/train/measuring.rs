//! Measurements of the training photographs, and the brightness of their targets.

use std::borrow::Cow;
use std::collections::BTreeMap;

use rayon::prelude::*;
use serde::Serialize;

use crate::Result;
use crate::photographs::dataset::{Dataset, MeasuredSize, View};
use crate::photographs::image::Image;
use crate::photographs::tone::{
    Exposure, MeasuredPhotograph, SceneTone, ToneLaw, ToneMapping, ToneSettings, all_black,
};

/// The exposure of the targets and of the model.
#[derive(Clone, Debug, Serialize)]
pub struct TargetExposure {
    /// The geometric mean of the views' gains: the exposure at which the model renders and is scored.
    pub model_gain: f64,
    /// The exposure of the training photographs together.
    pub scene: Exposure,
    /// The gain of every training view, by name.
    pub gains: BTreeMap<String, f64>,
}

impl TargetExposure {
    /// The exposure of these gains; `model_gain` is the recorded one, if any.
    pub(super) fn new(
        scene: Exposure,
        gains: BTreeMap<String, f64>,
        model_gain: Option<f64>,
    ) -> Self {
        let model_gain = model_gain.unwrap_or_else(|| geometric_mean(gains.values().copied()));
        Self { model_gain, scene, gains }
    }
}

/// The geometric mean of gains; 1 without any.
fn geometric_mean(gains: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = gains.len().max(1) as f64;
    (gains.map(f64::ln).sum::<f64>() / count).exp()
}

/// The training views that have a photograph, with their indices in the dataset.
pub(super) fn photographs(dataset: &Dataset) -> impl Iterator<Item = (usize, &View)> {
    let views = dataset.views.iter().enumerate();
    views.filter(|(_, view)| view.is_train() && view.has_photograph())
}

/// The scene's tone: that of the recorded law, or of the training photographs, which only then are measured.
pub(super) fn scene_of(settings: &ToneSettings, dataset: &Dataset) -> Result<SceneTone> {
    let training = if settings.law.is_some() { vec![] } else { measured(settings, dataset)? };
    scene_of_measured(settings, dataset, &training)
}

/// The scene's tone: that of the recorded law, or of these training photographs.
pub(super) fn scene_of_measured(
    settings: &ToneSettings,
    dataset: &Dataset,
    training: &[MeasuredPhotograph],
) -> Result<SceneTone> {
    match &settings.law {
        Some(path) => Ok(SceneTone::recorded(ToneLaw::load(path)?.check(path, settings)?)),
        None => settings.scene(training).ok_or_else(|| all_black(&dataset.root)),
    }
}

/// The tone mapping of a photograph of the scene: as recorded, or measured.
pub(super) fn tone_mapping_of(
    settings: &ToneSettings,
    scene: &SceneTone,
    view: &View,
    photograph: &Image,
) -> Result<ToneMapping> {
    if let Some(recorded) = scene.recorded_mapping(&view.name)? {
        return Ok(recorded);
    }
    let measured = MeasuredPhotograph::of(&view.counted(photograph)).seen_by(&view.camera);
    Ok(settings.tone_mapping(scene, &measured))
}

/// The tone law of a dataset: the mapping of every photograph for training and of every test photograph.
pub(crate) fn law_of(settings: &ToneSettings, dataset: &Dataset) -> Result<ToneLaw> {
    let tone = ToneSettings { law: None, ..settings.clone() };
    let training = measured(&tone, dataset)?;
    let scene = scene_of_measured(&tone, dataset, &training)?;
    let mut mappings = BTreeMap::new();
    for ((_, view), own) in photographs(dataset).zip(&training) {
        mappings.insert(view.name.clone(), tone.tone_mapping(&scene, own));
    }
    let gains: Vec<f64> = mappings.values().filter_map(|own: &ToneMapping| own.gain).collect();
    let is_exposed = scene.exposure.is_some() && tone.profile.is_none();
    let model_gain = is_exposed.then(|| geometric_mean(gains.into_iter()));
    for view in dataset.views.iter().filter(|view| !view.is_train() && view.has_photograph()) {
        if let Some(own) = measured_of(view, tone.full_resolution)? {
            mappings.insert(view.name.clone(), tone.tone_mapping(&scene, &own));
        }
    }
    Ok(ToneLaw { tone, exposure: scene.exposure, model_gain, mappings })
}

/// Measures each training photograph.
pub(super) fn measured(
    settings: &ToneSettings,
    dataset: &Dataset,
) -> Result<Vec<MeasuredPhotograph>> {
    let views: Vec<&View> = photographs(dataset).map(|(_, view)| view).collect();
    let pixels = |view: &&View| u64::from(view.camera.width) * u64::from(view.camera.height);
    let largest = views.iter().map(pixels).max().unwrap_or_default();
    let mut measured = vec![];
    for views in views.chunks(Image::decoded_at_once(largest)) {
        let of_views = views.par_iter().map(|view| measured_of(view, settings.full_resolution));
        measured.extend(of_views.collect::<Result<Vec<_>>>()?.into_iter().flatten());
    }
    Ok(measured)
}

/// The measurements of a view, already known if its photograph was measured while it was decoded.
pub(super) fn measured_of(
    view: &View,
    full_resolution: bool,
) -> Result<Option<MeasuredPhotograph>> {
    let size = if full_resolution { MeasuredSize::Own } else { MeasuredSize::Loaded };
    let read_anew = view.original.as_ref().filter(|_| full_resolution || view.image.is_none());
    let measured = match read_anew.and_then(|original| original.measured(size)) {
        Some(measured) => Some(measured.clone()),
        None => {
            let photograph = tone_map_source(view, full_resolution)?;
            photograph.map(|photograph| MeasuredPhotograph::of(&view.counted(&photograph)))
        }
    };
    Ok(measured.map(|measured| measured.seen_by(&view.camera)))
}

/// The image from which the target of a view is made: the photograph at full resolution if it is tone-mapped before it
/// is resized, else as it was loaded; `None` if the view has no photograph.
pub(super) fn tone_map_source(
    view: &View,
    full_resolution: bool,
) -> Result<Option<Cow<'_, Image>>> {
    if full_resolution { view.photograph() } else { view.loaded() }
}
