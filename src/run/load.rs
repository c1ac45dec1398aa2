//! What a run directory holds, read back.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::directory::{EXPOSURES, NETWORKS, VIEWS, view_lines};
use crate::dataset::Dataset;
use crate::exposure::{Affine, table};
use crate::gpu::Gpu;
use crate::scene::{Features, Gaussians, ply};
use crate::train::{ModelConfig, Networks};
use crate::{Error, Result};

/// The trained Gaussians of a run.
///
/// # Errors
/// The run has not been trained to its end or a checkpoint, or the file is cut short.
pub fn load_model(run: &Path, raw_colors: bool) -> Result<Gaussians> {
    let path = run.join("model.ply");
    if !path.is_file() {
        let problem = "has no model.ply: the run did not finish, nor come to a checkpoint; train it again, or go on with \
                       --resume";
        return Err(Error::input(run, problem));
    }
    let mut gaussians = ply::load(path)?;
    if raw_colors {
        gaussians.shift_colors(0.5);
    }
    Ok(gaussians)
}

/// The trained networks of a run; none where its model has none. `features` are those that its Gaussians came to have:
/// a part that found nothing to learn from has none, whatever the configuration asks for.
///
/// # Errors
/// Their file is missing or damaged, or holds networks of another configuration.
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

/// What the exposures of a run's training views make of its model, by name; none where it has learned none.
///
/// # Errors
/// The file is damaged.
pub fn load_exposures(run: &Path) -> Result<BTreeMap<String, Affine>> {
    let path = run.join(EXPOSURES);
    let known = if path.is_file() { table::load(&path)? } else { vec![] };
    Ok(known.into_iter().filter_map(|known| Some((known.name, known.affine?))).collect())
}

/// How the views of a dataset differ from those that a run was trained and scored on, in words; none where they are the
/// same, or the run does not say which those were.
pub fn other_views(run: &Path, dataset: &Dataset) -> Option<String> {
    let text = std::fs::read_to_string(run.join(VIEWS)).ok()?;
    let own: BTreeSet<&str> = text.lines().skip(1).collect();
    let lines = view_lines(dataset);
    let others: BTreeSet<&str> = lines.iter().map(String::as_str).collect();
    let [gone, new] = [own.difference(&others), others.difference(&own)].map(|lines| {
        let lines: Vec<&str> = lines.copied().collect();
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
