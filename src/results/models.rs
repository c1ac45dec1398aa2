//! Reads a model from a file of any format, or from a run directory.

use std::path::Path;

use crate::Result;
use crate::base::input;
use crate::error::Error;
use crate::results::export::{sog, spz};
use crate::results::run;
use crate::splats::model::{FileKind, Model};
use crate::splats::scene::ply::parts::PartFile;
use crate::splats::scene::{Gaussians, ModelFacts, ply};
use crate::train::TrainConfig;

impl Model {
    /// Reads a model: a PLY in the INRIA layout, of any trainer, SPZ, SOG, or a run directory. A file is recognised by
    /// its content, not by its name.
    ///
    /// The near plane, the alpha limit and the colours are those that the file states (`comment nightsplat near 0.1`)
    /// or those of the run's configuration; otherwise those of
    /// [`RenderSettings::default`](crate::RenderSettings::default).
    ///
    /// # Errors
    /// [`Error::Input`] if the file is missing, not a model, truncated or not finite, or states an invalid fact, or if
    /// the run neither finished nor reached a checkpoint.
    pub fn load(path: impl AsRef<Path>) -> Result<Self> {
        let (gaussians, facts) = read(path.as_ref())?;
        Ok(Self::of_shown(gaussians, &facts))
    }
}

/// The Gaussians in the colours that viewers show, and the facts that the file or the run's configuration states. Warns
/// if the near plane is missing.
pub(crate) fn read(path: &Path) -> Result<(Gaussians, ModelFacts)> {
    if path.is_dir() {
        let config = run::load_config(path)?;
        let gaussians = run::load_gaussians(path)?;
        let file = PartFile::open(&path.join("model.ply"), 1)?;
        return Ok((gaussians, facts_of_run(&config, file.as_ref())));
    }
    // A PLY without an end of its header may be long.
    PartFile::open(path, 1)?;
    let bytes = input::bytes(path)?;
    let parsed = match FileKind::from_bytes(&bytes) {
        Some(FileKind::Ply) => ply::parse(&bytes),
        Some(FileKind::Spz) => spz::decode(&bytes),
        Some(FileKind::Sog) => sog::decode(&bytes),
        None => Err("is not a model: neither PLY, SPZ nor SOG".to_owned()),
    };
    let (gaussians, facts) = parsed.map_err(|problem| Error::input(path, problem))?;
    warn_of(path, &facts);
    Ok((gaussians, facts))
}

/// Opens a PLY for reading part by part; `None` for other formats.
pub(crate) fn open_parts(path: &Path, part: usize) -> Result<Option<(PartFile, ModelFacts)>> {
    if path.is_dir() {
        let config = run::load_config(path)?;
        let file = PartFile::open(&path.join("model.ply"), part)?;
        let facts = facts_of_run(&config, file.as_ref());
        return Ok(file.map(|file| (file, facts)));
    }
    let file = PartFile::open(path, part)?;
    Ok(file.map(|file| {
        let facts = *file.facts();
        warn_of(path, &facts);
        (file, facts)
    }))
}

/// The facts of a run's configuration, and the law that its model states; that of joined blocks states none.
fn facts_of_run(config: &TrainConfig, model: Option<&PartFile>) -> ModelFacts {
    let law = model.and_then(|model| model.facts().law);
    ModelFacts { law, ..config.facts(&config.frame.unwrap_or_default()) }
}

fn warn_of(path: &Path, facts: &ModelFacts) {
    if facts.near.is_none() {
        tracing::warn!("{}: does not state its near plane; the default is used", path.display());
    }
    if let Some(stops) = facts.linear {
        let path = path.display();
        tracing::warn!(
            "{path}: its colours are linear light, raised by {stops} stops, and are shown as they are"
        );
    }
}
