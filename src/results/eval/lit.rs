//! Scores in the light of the lamp at the camera, against `lit/` of a dataset.

use std::path::PathBuf;

use serde_json::Value;

use super::{ScoredImages, ViewScore, other_scores, quantized};
use crate::Result;
use crate::photographs::dataset::{Dataset, View};
use crate::photographs::image::Image;
use crate::photographs::metrics::Scores;
use crate::train::Rendered;

/// The test views in the light of the lamp at the camera, bright and without noise, if a dataset has these.
pub(super) fn lit_folder(dataset: &Dataset) -> PathBuf {
    dataset.root.join("lit")
}

/// Adds the scores in the light of the lamp; `render` renders a view so.
pub(crate) fn score_lit(
    scored: &mut [ViewScore],
    dataset: &Dataset,
    mut render: impl FnMut(&View) -> Result<Rendered>,
) -> Result<()> {
    let folder = lit_folder(dataset);
    for score in scored {
        let path = folder.join(format!("{}.png", score.name));
        let view = dataset.test_views().find(|view| view.name == score.name);
        let Some(view) = view.filter(|_| path.is_file()) else { continue };
        let (width, height) = (view.camera.width, view.camera.height);
        let target = quantized(&Image::load(&path)?.resized(width, height));
        let compared = ScoredImages { view, render: quantized(render(view)?.output()), target };
        score.lit = Some(compared.aligned()?);
    }
    Ok(())
}

/// Adds to `metrics.json` the scores in the light of the lamp, if there are any.
pub(crate) fn add_lit(metrics: &mut Value, scored: &[ViewScore]) {
    if scored.iter().any(|view| view.lit.is_some()) {
        let what = "in the light of the lamp at the camera, against the dataset's lit/, after the least-squares gain \
                    and bias of each channel";
        metrics["lit_by_lamp"] = other_scores(what, scored, |view| view.lit);
    }
}

/// The mean scores in the light of the lamp, if there are any.
pub(crate) fn mean_lit(scored: &[ViewScore]) -> Option<Scores> {
    Scores::mean(&scored.iter().filter_map(|view| view.lit).collect::<Vec<_>>())
}
