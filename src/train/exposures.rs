//! Learned exposures of the training views, and their initial values.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use nightsplat_photographs::dataset::{Dataset, LoadOptions, Photograph, View};
use nightsplat_photographs::image::{Image, exposure_value, linear_from_srgb, srgb_from_linear};

use super::config::TrainConfig;
use super::views::Views;
use crate::targets::Targets;
use crate::{Error, Result};
use nightsplat_diagnose::exposures_at_points;
use nightsplat_photographs::exposures::{Affine, table};

/// The stops of linear light by which photographs are brighter than the mean of the training views, by view: from the
/// table of the configuration or the dataset, else from EXIF. Empty where no exposure is known, or all are alike.
pub(crate) fn known_stops(
    dataset: &Dataset,
    config: &TrainConfig,
) -> Result<BTreeMap<String, f64>> {
    /// The smallest difference that counts.
    const ALIKE: f64 = 0.01;
    let mut stops: BTreeMap<String, f64> = match table_of(dataset, config) {
        Some(path) => {
            table::load(&path)?.into_iter().filter_map(|row| Some((row.name, row.ev?))).collect()
        }
        None => {
            let photographs = Dataset::photographs(&dataset.root, &config.load_options());
            let stops = |photograph: &Photograph| {
                Some((photograph.name.clone(), exposure_value(&photograph.input)?))
            };
            photographs.unwrap_or_default().iter().filter_map(stops).collect()
        }
    };
    let training: Vec<f64> =
        dataset.train_views().filter_map(|view| stops.get(&view.name).copied()).collect();
    let mean = training.iter().sum::<f64>() / training.len().max(1) as f64;
    if training.is_empty() || stops.values().all(|stop| (stop - mean).abs() < ALIKE) {
        return Ok(BTreeMap::new());
    }
    stops.values_mut().for_each(|stop| *stop -= mean);
    Ok(stops)
}

/// The table of exposures of the configuration, or of the dataset.
fn table_of(dataset: &Dataset, config: &TrainConfig) -> Option<PathBuf> {
    let beside = Some(dataset.root.join("exposures.csv")).filter(|path| path.is_file());
    config.exposure.start.clone().or(beside)
}

/// The initial exposure of a view.
#[derive(Clone, Copy, Debug)]
enum InitialExposures {
    /// Stops of the photograph, up to a constant.
    Stops(f64),
    /// Gain and bias of the target.
    Affine(Affine),
}

impl Views {
    /// The exposures of the training views with their initial values; `None` if they are not learned.
    ///
    /// Initial values come from a table, else from the photographs' EXIF, else from points that several views show; a
    /// view without one starts at the identity.
    pub(super) fn exposures(
        &self,
        targets: &Targets,
        dataset: &Dataset,
        config: &TrainConfig,
    ) -> Result<Option<Vec<Affine>>> {
        if !config.exposure.learn {
            return Ok(None);
        }
        let starts = match table_of(dataset, config) {
            Some(path) => self.starts_of_table(&path, dataset)?,
            None => self.initial_exposures(dataset, &config.load_options())?,
        };
        // At points, exposures and the light of a lamp are not told apart.
        let measures = starts.is_empty() && !config.model.lamp;
        let starts = if measures { self.starts_of_points(dataset)? } else { starts };
        let stops = starts.values().filter_map(|start| match start {
            InitialExposures::Stops(stops) => Some(*stops),
            InitialExposures::Affine(_) => None,
        });
        let stops: Vec<f64> = stops.collect();
        let mean = stops.iter().sum::<f64>() / stops.len().max(1) as f64;
        let affine = |name: &str| match starts.get(name) {
            Some(InitialExposures::Affine(affine)) => Ok(*affine),
            Some(InitialExposures::Stops(stops)) => {
                affine_of_stops(targets, dataset, name, stops - mean)
            }
            None => Ok(Affine::IDENTITY),
        };
        self.names().map(affine).collect::<Result<Vec<_>>>().map(Some)
    }

    fn starts_of_table(
        &self,
        path: &Path,
        dataset: &Dataset,
    ) -> Result<BTreeMap<String, InitialExposures>> {
        let rows = table::load(path)?;
        let views: BTreeSet<&str> = dataset.views.iter().map(|view| view.name.as_str()).collect();
        let names = rows.iter().map(|rows| rows.name.as_str());
        let unknown: Vec<&str> = names.filter(|name| !views.contains(name)).collect();
        if !unknown.is_empty() {
            let problem = format!(
                "names views that are not in the dataset: {}; remove or correct them",
                unknown.join(", ")
            );
            return Err(Error::input(path, problem));
        }
        let start = |rows: table::KnownExposure| {
            let stops = rows.ev.map(InitialExposures::Stops);
            Some((rows.name, rows.affine.map(InitialExposures::Affine).or(stops)?))
        };
        let starts: BTreeMap<String, InitialExposures> =
            rows.into_iter().filter_map(start).collect();
        let missing: Vec<&str> = self.names().filter(|name| !starts.contains_key(*name)).collect();
        let file = path.display();
        if missing.is_empty() {
            tracing::info!("initial exposures from {file}");
        } else {
            let names = missing.join(", ");
            tracing::warn!("{file} lacks {names}: their exposures start at the identity");
        }
        Ok(starts)
    }

    fn starts_of_points(&self, dataset: &Dataset) -> Result<BTreeMap<String, InitialExposures>> {
        let exposures = exposures_at_points(dataset)?;
        let starts: BTreeMap<String, InitialExposures> = self
            .names()
            .filter_map(|name| {
                Some((name.to_owned(), InitialExposures::Stops(*exposures.get(name)?)))
            })
            .collect();
        let (found, all) = (starts.len(), self.names().count());
        tracing::info!("initial exposures of {found} of {all} photographs from shared points");
        Ok(starts)
    }

    fn initial_exposures(
        &self,
        dataset: &Dataset,
        options: &LoadOptions,
    ) -> Result<BTreeMap<String, InitialExposures>> {
        let photographs = Dataset::photographs(&dataset.root, options).unwrap_or_default();
        let names: BTreeSet<&str> = self.names().collect();
        let photographs_of_views =
            photographs.iter().filter(|photograph| names.contains(photograph.name.as_str()));
        let start = |photograph: &Photograph| {
            let stops = exposure_value(&photograph.input)?;
            Some((photograph.name.clone(), InitialExposures::Stops(stops)))
        };
        let starts: BTreeMap<String, InitialExposures> =
            photographs_of_views.filter_map(start).collect();
        match starts.len() {
            0 => {}
            all if all == names.len() => {
                tracing::info!("initial exposures from the photographs' EXIF");
            }
            some => {
                tracing::warn!(
                    "{some} of {} photographs have their exposure in EXIF; the others start at the identity",
                    names.len()
                );
            }
        }
        Ok(starts)
    }
}

/// The affine of the target for `stops` of the photograph in linear light: it maps the target of the photograph without
/// these stops to the target of the photograph as it is, by least squares. A curve that follows each photograph
/// compensates much of the difference.
fn affine_of_stops(targets: &Targets, dataset: &Dataset, name: &str, stops: f64) -> Result<Affine> {
    let views = &dataset.views;
    let found = views.binary_search_by(|view| view.name.as_str().cmp(name));
    let view = found.ok().map(|index| &views[index]);
    let photograph = view.map(View::loaded).transpose()?.flatten();
    let Some((view, photograph)) = view.zip(photograph) else { return Ok(Affine::IDENTITY) };
    let scale = (-stops).exp2() as f32;
    let without = |&x: &f32| srgb_from_linear(scale * linear_from_srgb(x));
    let neutral =
        Image { data: photograph.data.iter().map(without).collect(), ..*photograph.as_ref() };
    let target = |image: &Image| targets.target_of(view, image, || view.measured(image));
    let affine = Affine::least_squares(&target(&neutral)?, &target(&photograph)?)?;
    // A photograph of one colour determines no affine.
    let is_exposure = affine.gain.iter().all(|&gain| gain > 0.0);
    Ok(if is_exposure { affine } else { Affine::IDENTITY })
}
