//! The tone of a scene: from the measurements of its photographs to the curve of each.

use std::borrow::Cow;
use std::collections::BTreeMap;

use crate::image::decoded_at_once;
use crate::tone::scene_law;

mod recorded;

use rayon::prelude::*;

use crate::dataset::{Dataset, MeasuredSize, View};
use crate::image::Image;
use crate::tone::{
    Exposure, InverseTone, MeasuredPhotograph, SceneLaw, Statistics, Tone, ToneParameters,
    ToneSettings, all_black,
};
use nightsplat_core::camera::Camera;
use nightsplat_core::watch::Stage;
use nightsplat_core::{Error, Result};

/// A curve, with what is measured of the photographs of a scene.
#[derive(Clone, Debug)]
pub struct SceneTone {
    settings: ToneSettings,
    /// The means over the training photographs, if one curve is used for all.
    statistics: Option<Statistics>,
    /// The exposure of the targets, if the curve follows it.
    pub exposure: Option<Exposure>,
    /// All training photographs as one.
    together: MeasuredPhotograph,
    /// The geometric mean of the gains of the training photographs, if the curve follows the exposure: the exposure at
    /// which the model renders and is scored.
    pub model_gain: Option<f64>,
    /// By the name of the view: the curve of each training photograph, or as recorded.
    curves: BTreeMap<String, ToneParameters>,
    /// By the name of the view: see [`SceneTone::gain_of`].
    gains: BTreeMap<String, f64>,
    /// Whether the curves are those of a recorded law, and no photograph is measured for its own.
    is_recorded: bool,
}

/// The training views that have a photograph, with their indices in the dataset.
pub fn photographs(dataset: &Dataset) -> impl Iterator<Item = (usize, &View)> {
    let views = dataset.views.iter().enumerate();
    views.filter(|(_, view)| view.is_train() && view.has_photograph())
}

impl SceneTone {
    /// A scene of which nothing is measured.
    pub fn new(settings: &ToneSettings) -> Self {
        Self {
            settings: settings.clone(),
            statistics: None,
            exposure: None,
            together: MeasuredPhotograph::default(),
            model_gain: None,
            curves: BTreeMap::new(),
            gains: BTreeMap::new(),
            is_recorded: false,
        }
    }

    /// The scene of these training photographs; `None` if their exposure is needed and all are almost black, or there
    /// are none.
    pub fn from_photographs(
        settings: &ToneSettings,
        training: &[MeasuredPhotograph],
    ) -> Option<Self> {
        let exposure = if settings.takes_exposure() {
            let luminances = training.iter().map(|one| &one.luminance);
            let found = Exposure::measure(luminances, settings.brightness)?;
            let seen = training.iter().map(|one| Some((&one.luminance, one.camera?)));
            let found = match seen.collect::<Option<Vec<_>>>() {
                Some(seen) => found.seen_by(seen),
                None => found,
            };
            Some(if settings.scene_statistics { found.shared() } else { found })
        } else {
            None
        };
        let together = MeasuredPhotograph::together(training);
        let is_shared = settings.scene_statistics && !training.is_empty();
        let statistics = is_shared.then_some(together.statistics);
        Some(Self { statistics, exposure, together, ..Self::new(settings) })
    }

    /// The scene of a dataset, whose training photographs are measured.
    pub fn measure(settings: &ToneSettings, dataset: &Dataset) -> Result<Self> {
        let views: Vec<&View> = photographs(dataset).map(|(_, view)| view).collect();
        let training = measured(&views, settings.full_resolution)?;
        if let Some(recorded) = Self::recorded(settings)? {
            return Ok(Self { together: MeasuredPhotograph::together(&training), ..recorded });
        }
        let scene = Self::from_photographs(settings, &training);
        let mut scene = scene.ok_or_else(|| all_black(&dataset.root))?;
        views.iter().zip(&training).for_each(|(view, measured)| scene.add(&view.name, measured));
        scene.model_gain = scene.model_exposure().map(|_| {
            let sum: f64 = scene.gains.values().map(|gain| gain.ln()).sum();
            (sum / scene.gains.len().max(1) as f64).exp()
        });
        Ok(scene)
    }

    /// The law of a dataset: with the curve of every test photograph, too.
    pub fn measure_all(settings: &ToneSettings, dataset: &Dataset) -> Result<Self> {
        let mut scene = Self::measure(&ToneSettings { law: None, ..settings.clone() }, dataset)?;
        for view in dataset.views.iter().filter(|view| !view.is_train()) {
            if let Some(measured) = measured_of(view, settings.full_resolution)? {
                scene.add(&view.name, &measured);
            }
        }
        Ok(scene)
    }

    /// Keeps the curve of a measured photograph, and its gain.
    fn add(&mut self, name: &str, photograph: &MeasuredPhotograph) {
        self.curves.insert(name.to_owned(), self.curve_of(photograph));
        self.gains.extend(self.gain_of(photograph).map(|gain| (name.to_owned(), gain)));
    }

    /// The curve and its constants.
    pub fn settings(&self) -> &ToneSettings {
        &self.settings
    }

    /// All training photographs as one.
    pub fn together(&self) -> &MeasuredPhotograph {
        &self.together
    }

    /// The exposure that the model has; a profile determines the brightness of its targets.
    pub fn model_exposure(&self) -> Option<&Exposure> {
        self.exposure.as_ref().filter(|_| !matches!(self.settings.curve, Tone::Profile(_)))
    }

    /// See [`Exposure::has_black_sky`]; not, if the curve does not follow the exposure.
    pub fn has_black_sky(&self) -> bool {
        self.exposure.as_ref().is_some_and(Exposure::has_black_sky)
    }

    /// The gains of a dataset's training views, by name: see [`SceneTone::gain_of`].
    pub fn gains<'a>(&self, dataset: &'a Dataset) -> BTreeMap<&'a str, f64> {
        let gain = |(_, view): (usize, &'a View)| Some((&*view.name, *self.gains.get(&view.name)?));
        photographs(dataset).filter_map(gain).collect()
    }

    /// The image from which the target of a view is made: the photograph at full resolution if it is tone-mapped before
    /// it is resized, else as it was loaded; `None` if the view has no photograph.
    pub fn source<'a>(&self, view: &'a View) -> Result<Option<Cow<'a, Image>>> {
        source(view, self.settings.full_resolution)
    }

    /// The curve of a measured photograph.
    pub fn curve_of(&self, photograph: &MeasuredPhotograph) -> ToneParameters {
        let MeasuredPhotograph { luminance, camera, .. } = photograph;
        self.curve_at(photograph, |exposure| exposure.gain_of(luminance, camera.as_ref()))
    }

    /// k of soft(x; k), whose mean luminance the target of a measured photograph has; `None` if its curve does not
    /// follow the exposure, or it is its own target.
    pub fn gain_of(&self, photograph: &MeasuredPhotograph) -> Option<f64> {
        let MeasuredPhotograph { luminance, camera, .. } = photograph;
        let exposure = self.exposure.as_ref().filter(|exposure| !exposure.is_lit(luminance))?;
        Some(exposure.gain_of(luminance, camera.as_ref()))
    }

    /// The curve of a measured photograph, at this gain if it follows the exposure.
    fn curve_at(
        &self,
        photograph: &MeasuredPhotograph,
        gain: impl FnOnce(&Exposure) -> f64,
    ) -> ToneParameters {
        let statistics = self.statistics.as_ref().unwrap_or(&photograph.statistics);
        let curve = self.settings.parameters(statistics);
        let Some(exposure) = &self.exposure else { return curve };
        self.settings.exposed(exposure, curve, &photograph.luminance, gain(exposure))
    }

    /// The curve of a view; `None` without a photograph.
    pub fn curve_of_view(&self, view: &View) -> Result<Option<ToneParameters>> {
        if self.is_recorded || self.curves.contains_key(&view.name) {
            return self.known(view).map(Some);
        }
        let measured = measured_of(view, self.settings.full_resolution)?;
        Ok(measured.map(|measured| self.curve_of(&measured)))
    }

    /// The curve of a view with a photograph of these measurements, which a recorded law does not need.
    pub fn curve_for(
        &self,
        view: &View,
        measured: impl FnOnce() -> MeasuredPhotograph,
    ) -> Result<ToneParameters> {
        if self.is_recorded { self.known(view) } else { Ok(self.curve_of(&measured())) }
    }

    fn known(&self, View { name, .. }: &View) -> Result<ToneParameters> {
        let missing =
            || Error::Usage(format!("the tone law lacks the view {name}; it is another dataset's"));
        self.curves.get(name).copied().ok_or_else(missing)
    }

    /// From the target of a view to its photograph; of a view without one, to what its camera sees.
    pub fn inverse(&self, view: &View) -> Result<InverseTone> {
        match self.curve_of_view(view)? {
            Some(curve) => InverseTone::new(&self.settings, &curve),
            None => self.inverse_at(&view.camera),
        }
    }

    /// The inverse for a camera, at the exposure of the photographs around it: all cameras share one unit of light, as
    /// far as the photographs share an exposure.
    pub fn inverse_at(&self, camera: &Camera) -> Result<InverseTone> {
        let curve = self.curve_at(&self.together, |exposure| exposure.gain_around(camera));
        InverseTone::new(&self.settings, &curve)
    }

    /// The inverse of the whole scene, at the exposure of all photographs together.
    pub fn inverse_of_scene(&self) -> Result<InverseTone> {
        InverseTone::new(&self.settings, &self.curve_of(&self.together))
    }

    /// The curve of the whole scene, whose inverse is [`SceneTone::inverse_of_scene`].
    pub fn law(&self) -> Result<SceneLaw> {
        scene_law(&self.settings, &self.curve_of(&self.together))
    }
}

/// Measures the photographs of views that have one.
fn measured(views: &[&View], full_resolution: bool) -> Result<Vec<MeasuredPhotograph>> {
    let pixels = |view: &&View| u64::from(view.camera.width) * u64::from(view.camera.height);
    let largest = views.iter().map(pixels).max().unwrap_or_default();
    let stage = Stage::begin("measuring photographs", views.len());
    let mut measured = vec![];
    for views in views.chunks(decoded_at_once(largest)) {
        let of_views = views.par_iter().with_max_len(1).map(|view| {
            stage.next()?;
            measured_of(view, full_resolution)
        });
        measured.extend(of_views.collect::<Result<Vec<_>>>()?.into_iter().flatten());
    }
    Ok(measured)
}

/// The measurements of a view, already known if its photograph was measured while it was decoded.
fn measured_of(view: &View, full_resolution: bool) -> Result<Option<MeasuredPhotograph>> {
    let size = if full_resolution { MeasuredSize::Own } else { MeasuredSize::Loaded };
    let read_anew = view.original.as_ref().filter(|_| full_resolution || view.image.is_none());
    Ok(match read_anew.and_then(|original| original.measured(size)) {
        Some(measured) => Some(measured.clone().seen_by(&view.camera)),
        None => source(view, full_resolution)?.map(|photograph| view.measured(&photograph)),
    })
}

fn source(view: &View, full_resolution: bool) -> Result<Option<Cow<'_, Image>>> {
    if full_resolution { view.photograph() } else { view.loaded() }
}
