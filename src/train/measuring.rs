//! Measurements of the training photographs, and the brightness of their targets.

use std::borrow::Cow;
use std::collections::BTreeMap;

use rayon::prelude::*;
use serde::Serialize;

use crate::Result;
use crate::photographs::dataset::{Dataset, MeasuredSize, View};
use crate::photographs::image::Image;
use crate::photographs::tone::{Exposure, MeasuredPhotograph, SceneTone, ToneSettings, all_black};

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
    pub(super) fn new(scene: Exposure, gains: BTreeMap<String, f64>) -> Self {
        let logarithms: f64 = gains.values().map(|gain| gain.ln()).sum();
        let model_gain = (logarithms / gains.len().max(1) as f64).exp();
        Self { model_gain, scene, gains }
    }
}

/// The training views that have a photograph, with their indices in the dataset.
pub(super) fn photographs(dataset: &Dataset) -> impl Iterator<Item = (usize, &View)> {
    let views = dataset.views.iter().enumerate();
    views.filter(|(_, view)| view.is_train() && view.has_photograph())
}

/// Measures the training photographs, together and each.
///
/// # Errors
/// Every photograph is black and their exposure is needed, or a photograph can no longer be read.
pub(super) fn measured(
    settings: &ToneSettings,
    dataset: &Dataset,
) -> Result<(SceneTone, Vec<MeasuredPhotograph>)> {
    let views: Vec<&View> = photographs(dataset).map(|(_, view)| view).collect();
    let pixels = |view: &&View| u64::from(view.camera.width) * u64::from(view.camera.height);
    let largest = views.iter().map(pixels).max().unwrap_or_default();
    let mut measured = vec![];
    for views in views.chunks(Image::decoded_at_once(largest)) {
        let of_views = views.par_iter().map(|view| measured_of(view, settings.full_resolution));
        measured.extend(of_views.collect::<Result<Vec<_>>>()?.into_iter().flatten());
    }
    let scene = settings.scene(&measured).ok_or_else(|| all_black(&dataset.root))?;
    Ok((scene, measured))
}

/// The measurements of a view, already known if its photograph was measured while it was decoded.
///
/// # Errors
/// Those of [`tone_map_source`].
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
///
/// # Errors
/// Those of [`View::photograph`].
pub(super) fn tone_map_source(
    view: &View,
    full_resolution: bool,
) -> Result<Option<Cow<'_, Image>>> {
    if full_resolution { view.photograph() } else { view.loaded() }
}
