//! What is odd about photographs at points that several of them show.

use std::path::Path;

use nightsplat_photographs::dataset::exclude::pattern_of;
use nightsplat_photographs::dataset::{
    Dataset, LoadOptions, MeasuredSize, Photograph, RowBands, Split, View,
};

use super::geometry::SceneGeometry;
use super::lamp::{LampObservations, shading};

/// Every third photograph is looked at, if there are as many as this: a point is seen by several of them.
const EVERY: usize = 3;
const LOOKED_AT: usize = 15;

/// Remarks on rows and corners of a dataset's training photographs, at shared points; none if it cannot be loaded.
pub fn remarks_at_points(dataset: &Path, options: LoadOptions) -> Vec<String> {
    let options = LoadOptions {
        load_low_test: false,
        mask_borders: false,
        mask_overlays: false,
        falloff: Some([0.0; 2]),
        bands: Some(RowBands::default()),
        measured: MeasuredSize::None,
        ..options
    };
    // The files are listed, with warnings, before.
    let unlogged = tracing::subscriber::NoSubscriber::default();
    let load = || {
        let (photographs, ..) = Dataset::listed(dataset, &options).ok()?;
        let exclude = [options.exclude.clone(), not_looked_at(&photographs)].concat();
        Dataset::load(dataset, &LoadOptions { exclude, ..options.clone() }).ok()
    };
    let Some(loaded) = tracing::subscriber::with_default(unlogged, load) else { return vec![] };
    let views: Vec<(usize, &View)> =
        loaded.views.iter().enumerate().filter(|(_, view)| view.is_for_training()).collect();
    let Ok(shared) = SceneGeometry::measure(&loaded, &views) else { return vec![] };
    let Ok(tracks) = LampObservations::new(&shared.observations, views.len()) else {
        return vec![];
    };
    let names: Vec<&str> = views.iter().map(|(_, view)| view.name.as_str()).collect();
    let (falloff, bands, _) = shading(tracks, &names, shared.corner);
    let rows = bands.is_found().then(|| bands.why());
    let corners = falloff.is_found().then(|| falloff.why());
    rows.into_iter().chain(corners).map(|why| why + "; `train` evens them out").collect()
}

/// Patterns of the photographs for tests, and of those between the ones that are looked at.
fn not_looked_at(photographs: &[Photograph]) -> Vec<String> {
    let (training, test): (Vec<_>, Vec<_>) =
        photographs.iter().partition(|one| one.split == Split::Train);
    let every = (training.len() / LOOKED_AT).clamp(1, EVERY);
    let between = training.iter().enumerate().filter(|(index, _)| index % every != 0);
    let left_out = between.map(|(_, one)| one).chain(&test);
    left_out.map(|one| pattern_of(&one.name)).collect()
}
