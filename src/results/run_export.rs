//! The export of a run or of a model file.

mod fit;
mod page;
pub(crate) mod up;

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use glam::{DQuat, DVec3};
use nightsplat_core::output::{create_folder_of, is_same_file, own_file, write_whole};
use nightsplat_models::edit::operation::fingerprint;
use nightsplat_models::export::page::ModelPage;
use nightsplat_models::export::streamed::{self, Division, TileLoader, Written};
use nightsplat_models::export::{Format, Provenance};
use nightsplat_models::gaussians::{Gaussians, MAX_SH_DEGREE, ModelFacts};
use nightsplat_models::joined::TileManifest;
use nightsplat_models::levels;
use nightsplat_models::linear_light::linear_gaussians;
use nightsplat_photographs::dataset::Dataset;
use nightsplat_photographs::scene_tone::SceneTone;

pub(crate) use self::page::SHARED_GLSL;
use self::up::Turn;
pub use self::up::Up;
use crate::results::finished_run::{Opener, config_of_file, is_model, needs_photographs};
use crate::results::{models, run};
use crate::train::TrainConfig;
use crate::{Error, Result};

/// What is exported, and how.
#[derive(Debug)]
pub(crate) struct ExportOptions<'a> {
    /// A run directory or a model file.
    pub(crate) source: &'a Path,
    pub(crate) format: Format,
    /// `None`: the model's name with the ending of the format.
    pub(crate) out: Option<&'a Path>,
    /// `None`: the run's, for formats whose readers interpret the axes.
    pub(crate) up: Option<Up>,
    /// Whether colours are in linear light.
    pub(crate) linear: bool,
    /// The level of detail.
    pub(crate) level: usize,
    pub(crate) division: Division,
    /// The most bytes of the file.
    pub(crate) max_size: Option<u64>,
    /// The number of views of a page.
    pub(crate) views: usize,
    /// The title of a page, the text below it, and the address at which it will lie.
    pub(crate) title: Option<&'a str>,
    pub(crate) text: Option<&'a str>,
    pub(crate) address: Option<&'a str>,
    /// `None`: the run's.
    pub(crate) dataset: Option<&'a Path>,
    pub(crate) opener: Opener,
}

/// A written export.
#[derive(Debug)]
pub(crate) struct Exported {
    pub(crate) path: PathBuf,
    /// The number of Gaussians of the finest level.
    pub(crate) count: usize,
    /// What a limited size left of the model; empty without a limit.
    pub(crate) fitted: String,
    /// The levels of a streamed model.
    pub(crate) streamed: Option<Written>,
    /// The position in the world that those of the file are relative to.
    pub(crate) origin: DVec3,
    pub(crate) turn: Option<Turn>,
}

impl ExportOptions<'_> {
    /// Writes the export.
    pub(crate) fn write(&self) -> Result<Exported> {
        let joined =
            if is_model(self.source) { None } else { TileManifest::of_scene(self.source)? };
        match joined {
            Some(tiles) if self.format == Format::StreamedSog => self.write_tiles(&tiles),
            joined => self.write_whole(joined.as_ref()),
        }
    }

    /// Writes the tiles of a joined model, one at a time.
    fn write_tiles(&self, manifest: &TileManifest) -> Result<Exported> {
        let config = run::load_config(self.source)?;
        let turn = self.turn(&config);
        let rotation = turn.as_ref().map_or(DQuat::IDENTITY, |turn| turn.rotation);
        let facts = config.facts(&config.frame.unwrap_or_default());
        let provenance = Provenance { rotation, facts, ..self.provenance(&config) };
        let tiles: Vec<TileLoader<'_>> = manifest
            .tiles
            .iter()
            .map(|tile| TileLoader {
                name: manifest.folder.join(&tile.file),
                count: tile.count,
                load: Box::new(move || Ok(Cow::Owned(turned(manifest.read(tile)?, rotation)))),
            })
            .collect();
        let path = self.path()?;
        let written = streamed::write(&path, &tiles, &provenance, self.division)?;
        let (count, origin) = (written.counts[0], DVec3::ZERO);
        Ok(Exported { path, count, fitted: String::new(), streamed: Some(written), origin, turn })
    }

    fn write_whole(&self, joined: Option<&TileManifest>) -> Result<Exported> {
        let (gaussians, facts, config) = self.open()?;
        let (gaussians, facts) = match self.linear {
            true => self.in_linear_light(&gaussians, facts, &config)?,
            false => (gaussians, facts),
        };
        let default_path = self.default_path();
        let named = self.out.unwrap_or(&default_path);
        if self.format == Format::Ply && is_same_file(named, &default_path) {
            let problem = "is the model itself; name another file with --out";
            return Err(Error::output(named, problem));
        }
        let path = self.path()?;
        let source = self.source.display();
        if let Some(step) = run::stopped_at(self.source) {
            tracing::warn!("{source}: stopped at step {step} of {}", config.steps);
        }
        if has_networks(&config) {
            tracing::warn!("{source}: the networks are not exported, only the Gaussians");
        }
        let turn = self.turn(&config);
        let rotation = turn.as_ref().map_or(DQuat::IDENTITY, |turn| turn.rotation);
        let mut gaussians = turned(gaussians, rotation);
        if self.level > 0 {
            let tiles = joined.map_or_else(|| vec![gaussians.count], TileManifest::counts);
            gaussians = levels::level(&gaussians, &tiles, self.division.cell(), self.level);
        }
        let provenance = Provenance { rotation, facts, ..self.provenance(&config) };
        create_folder_of(&path)?;
        let page = match self.format {
            Format::Html => Some(self.page(&config, gaussians.origin, provenance.clone())?),
            _ => None,
        };
        let write = |model: &Gaussians| self.write_file(model, &provenance, page.as_ref(), &path);
        let (mut fitted, mut streamed) = (String::new(), None);
        if let Some(most) = self.max_size {
            let write = |model: &Gaussians| write(model).map(drop);
            (gaussians, fitted) = self.fit(&gaussians, &path, most, write)?;
        } else {
            streamed = write(&gaussians)?;
        }
        let poster = page.as_ref().map(|page| page.sharing.poster_file()).transpose()?.flatten();
        if let Some((path, poster)) = self.poster_path().zip(poster) {
            write_whole(&path, &poster)?;
        }
        let (count, origin) = (gaussians.count, gaussians.origin);
        Ok(Exported { path, count, fitted, streamed, origin, turn })
    }

    fn write_file(
        &self,
        gaussians: &Gaussians,
        provenance: &Provenance,
        page: Option<&ModelPage<'_>>,
        path: &Path,
    ) -> Result<Option<Written>> {
        match (self.format, page) {
            // Viewers with a fixed layout expect the coefficients of degree 3.
            (Format::Ply, _) => {
                Format::Ply.write(&gaussians.with_sh_degree(MAX_SH_DEGREE), provenance, path)?;
            }
            (Format::StreamedSog, _) => {
                let tile = TileLoader::whole(self.source, gaussians);
                return streamed::write(path, &[tile], provenance, self.division).map(Some);
            }
            (Format::Html, Some(page)) => {
                let fingerprint = Some(fingerprint(gaussians));
                let page = ModelPage { gaussians: Some(gaussians), fingerprint, ..page.clone() };
                write_whole(path, page.html(&SHARED_GLSL)?.as_bytes())?;
            }
            (format, _) => format.write(gaussians, provenance, path)?,
        }
        Ok(None)
    }

    /// The poster beside a page whose address is known, where services that show links find it.
    fn poster_path(&self) -> Option<PathBuf> {
        self.address?;
        Some(self.out.map_or_else(|| self.default_path(), Path::to_owned).with_extension("jpg"))
    }

    /// The model as stored, what is stated of it, and its settings.
    fn open(&self) -> Result<(Gaussians, ModelFacts, TrainConfig)> {
        let source = self.source;
        if !is_model(source) {
            let config = run::load_config(source)?;
            let (gaussians, facts) = models::read(source)?;
            return Ok((gaussians, facts, config));
        }
        let (gaussians, facts) = models::read(source)?;
        if self.format == Format::Html && self.dataset.is_none() {
            return Err(needs_photographs(source));
        }
        let config = config_of_file(source, &gaussians, &facts, self.dataset)?;
        Ok((gaussians, facts, config))
    }

    /// The model in linear light, and the facts that state it.
    fn in_linear_light(
        &self,
        gaussians: &Gaussians,
        facts: ModelFacts,
        config: &TrainConfig,
    ) -> Result<(Gaussians, ModelFacts)> {
        let config = self.with_dataset(config);
        let dataset = Dataset::load(&config.dataset, &config.load_options())?;
        let inverse = SceneTone::measure(&config.tone, &dataset)?.inverse_of_scene()?;
        let stops = inverse.stops_to_target();
        let (linear, clipped) = linear_gaussians(gaussians, &inverse, stops);
        if clipped > 0 {
            let count = gaussians.count;
            tracing::warn!(
                "{clipped} of {count} Gaussians are as bright as the tone curve gets in some direction: their light is \
                 at least what is written"
            );
        }
        Ok((linear, ModelFacts { linear: Some(stops as f32), law: None, targets: None, ..facts }))
    }

    /// The settings with the dataset where it is now.
    fn with_dataset(&self, config: &TrainConfig) -> TrainConfig {
        let mut config = config.clone();
        if let Some(dataset) = self.dataset {
            config.move_dataset(dataset);
        }
        config
    }

    fn provenance(&self, config: &TrainConfig) -> Provenance {
        let dataset = config.dataset.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if is_model(self.source) {
            return Provenance { dataset, ..Provenance::default() };
        }
        let exposure = run::load_target_exposure(self.source).map(|exposure| {
            let gain = exposure.model_gain;
            format!("{gain:.2} times that of its photographs, before the curve")
        });
        Provenance {
            dataset,
            curve: config.tone.curve.to_string(),
            exposure: exposure.unwrap_or_else(|| "that of its targets".to_owned()),
            ..Provenance::default()
        }
    }

    /// The file to write. In a run, it replaces a link.
    fn path(&self) -> Result<PathBuf> {
        match self.out {
            Some(out) => Ok(out.to_owned()),
            None if is_model(self.source) => Ok(self.default_path()),
            None => own_file(self.default_path()),
        }
    }

    fn default_path(&self) -> PathBuf {
        let ending = self.format.name();
        match is_model(self.source) {
            true => self.source.with_extension(ending),
            false => self.source.join(format!("model.{ending}")),
        }
    }
}

/// Whether the model of a run has networks, which no file format holds.
fn has_networks(config: &TrainConfig) -> bool {
    config.model.denoiser || config.model.tonemapper
}

/// The rotated model; unchanged for the identity.
fn turned(gaussians: Gaussians, rotation: DQuat) -> Gaussians {
    if rotation == DQuat::IDENTITY { gaussians } else { gaussians.rotated(rotation) }
}
