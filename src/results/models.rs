//! Reads and writes models: files of any format, and run directories.

use std::path::Path;

use nightsplat_models::export::{Format, Provenance};
use nightsplat_models::files;
use nightsplat_models::gaussians::ply::parts::PartFile;
use nightsplat_models::gaussians::{Gaussians, ModelFacts};

use crate::Result;
use crate::results::run;
use crate::splats::model::Model;
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
    /// [`Error::Input`](crate::Error::Input) if the file is missing, not a model or truncated, states an invalid fact,
    /// or has no Gaussian that is finite, others being left out with a warning, or if the run neither finished nor
    /// reached a checkpoint.
    pub fn load(path: impl AsRef<Path>) -> Result<Self> {
        let (gaussians, facts) = read(path.as_ref())?;
        Ok(Self::of_shown(gaussians, &facts))
    }

    /// Writes the model in the format that the file's extension names: `.ply`, `.spz`, `.glb`, `.usda`, `.usdz` or
    /// `.sog`. The file states the near plane, the alpha limit, the colours and the origin.
    ///
    /// # Errors
    /// As [`Gaussians::save`].
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        let path = path.as_ref();
        self.save_as(path, Format::from_path(path)?)
    }

    /// Writes the model in a format, regardless of the file's extension.
    ///
    /// # Errors
    /// As [`Gaussians::save`].
    pub fn save_as(&self, path: impl AsRef<Path>, format: Format) -> Result<()> {
        let provenance = Provenance { facts: self.facts(), ..Provenance::default() };
        format.write(&self.shown(), &provenance, path.as_ref())
    }
}

/// The Gaussians in the colours that viewers show, and the facts that the file or the run's configuration states.
/// Warns as [`files::read`].
pub(crate) fn read(path: &Path) -> Result<(Gaussians, ModelFacts)> {
    if !path.is_dir() {
        return files::read(path);
    }
    let config = run::load_config(path)?;
    let gaussians = run::load_gaussians(path)?;
    let file = PartFile::open(&path.join("model.ply"), 1)?;
    Ok((gaussians, facts_of_run(&config, file.as_ref())))
}

/// Opens a PLY, or that of a run, for reading part by part; `None` for other formats.
pub(crate) fn open_parts(path: &Path, part: usize) -> Result<Option<(PartFile, ModelFacts)>> {
    if !path.is_dir() {
        return files::open_parts(path, part);
    }
    let config = run::load_config(path)?;
    let file = PartFile::open(&path.join("model.ply"), part)?;
    let facts = facts_of_run(&config, file.as_ref());
    Ok(file.map(|file| (file, facts)))
}

/// The facts of a run's configuration, and the law that its model states; that of joined blocks states none.
fn facts_of_run(config: &TrainConfig, model: Option<&PartFile>) -> ModelFacts {
    let law = model.and_then(|model| model.facts().law);
    ModelFacts { law, ..config.facts(&config.frame.unwrap_or_default()) }
}
