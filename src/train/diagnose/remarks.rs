//! What is odd about photographs at points that several of them show.

use nightsplat_photographs::dataset::{Dataset, LoadOptions, MeasuredSize, View};

use super::geometry::SceneGeometry;
use super::lamp::{LampObservations, bands, falloff::FalloffDiagnosis};
use crate::train::config::TrainConfig;

/// Remarks on rows and corners of a dataset's training photographs, at shared points; none if it cannot be loaded.
pub(crate) fn remarks_at_points(config: &TrainConfig) -> Vec<String> {
    let options = LoadOptions {
        load_low_test: false,
        mask_borders: false,
        mask_overlays: false,
        falloff: Some([0.0; 2]),
        measured: MeasuredSize::None,
        ..config.load_options()
    };
    // The files are listed, with warnings, before.
    let unlogged = tracing::subscriber::NoSubscriber::default();
    let load = || Dataset::load(&config.dataset, &options).ok();
    let Some(dataset) = tracing::subscriber::with_default(unlogged, load) else { return vec![] };
    let views: Vec<(usize, &View)> =
        dataset.views.iter().enumerate().filter(|(_, view)| view.is_for_training()).collect();
    let Ok(shared) = SceneGeometry::measure(&dataset, &views) else { return vec![] };
    let Ok(tracks) = LampObservations::new(&shared.observations, views.len()) else {
        return vec![];
    };
    let falloff = FalloffDiagnosis::new(&tracks, shared.corner);
    let corners = falloff.is_found().then(|| falloff.why() + "; `train` evens them out");
    bands::remark(&tracks).into_iter().chain(corners).collect()
}
