//! From the measurements of a scene's photographs to the curve of each.

use std::sync::Arc;

use super::exposure::{Exposure, solved};
use super::histogram::LuminanceHistogram;
use super::law::{clamped, curve_at};
use super::recorded::{ToneLaw, ToneMapping};
use super::{Statistics, ToneCurve, ToneParameters, ToneSettings};
use crate::camera::Camera;
use crate::{Error, Result};

/// Minimum and maximum of a solved gain.
const STRENGTHS: [f64; 2] = [1e-3, 1e4];

/// Measurements of a photograph.
#[derive(Clone, Debug)]
pub struct MeasuredPhotograph {
    /// Percentiles and means.
    pub statistics: Statistics,
    /// The histogram of its luminance.
    pub luminance: LuminanceHistogram,
    /// Its camera, if known.
    pub camera: Option<Camera>,
}

impl MeasuredPhotograph {
    /// Measures the planes (3, pixels) of a photograph.
    pub fn of(planes: &[f32]) -> Self {
        let (statistics, luminance) = (Statistics::of(planes), LuminanceHistogram::of(planes));
        Self { statistics, luminance, camera: None }
    }

    /// Adds the camera.
    #[must_use]
    pub fn seen_by(self, camera: &Camera) -> Self {
        Self { camera: Some(*camera), ..self }
    }
}

/// The shared part of the curves of a scene's photographs.
#[derive(Clone, Debug, Default)]
pub struct SceneTone {
    /// The means over the training photographs, if one curve is used for all.
    statistics: Option<Statistics>,
    /// The exposure of the targets, if it is automatic.
    pub exposure: Option<Exposure>,
    /// The recorded mappings, if the photographs are not measured.
    law: Option<Arc<ToneLaw>>,
}

impl SceneTone {
    /// The scene whose photographs are mapped as recorded.
    pub(crate) fn recorded(law: ToneLaw) -> Self {
        Self { statistics: None, exposure: law.exposure.clone(), law: Some(Arc::new(law)) }
    }

    /// The recorded mapping of a view's photograph; `None` if photographs are measured.
    pub(crate) fn recorded_mapping(&self, view: &str) -> Result<Option<ToneMapping>> {
        let Some(law) = &self.law else { return Ok(None) };
        let missing =
            || Error::Usage(format!("the tone law lacks the view {view}; it is another dataset's"));
        law.mappings.get(view).copied().map(Some).ok_or_else(missing)
    }

    /// The recorded gain at which the model renders.
    pub(crate) fn recorded_gain(&self) -> Option<f64> {
        self.law.as_ref()?.model_gain
    }
}

impl ToneSettings {
    /// The shared part of the curves of a scene, from its training photographs; `None` if their exposure is needed and
    /// all are almost black, or there are none.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn scene(&self, training: &[MeasuredPhotograph]) -> Option<SceneTone> {
        let exposure = if self.takes_exposure() {
            let found = Exposure::of(training.iter().map(|one| &one.luminance), self.brightness)?;
            let seen = training.iter().map(|one| Some((&one.luminance, one.camera?)));
            let found = match seen.collect::<Option<Vec<_>>>() {
                Some(seen) => found.seen_by(seen),
                None => found,
            };
            Some(if self.scene_statistics { found.shared() } else { found })
        } else {
            None
        };
        let statistics: Vec<_> = training.iter().map(|one| one.statistics).collect();
        let statistics = Statistics::mean_of(&statistics).filter(|_| self.scene_statistics);
        Some(SceneTone { statistics, exposure, law: None })
    }

    /// The tone mapping of a photograph of the scene.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn tone_mapping(
        &self,
        scene: &SceneTone,
        photograph: &MeasuredPhotograph,
    ) -> ToneMapping {
        let statistics = scene.statistics.as_ref().unwrap_or(&photograph.statistics);
        let parameters = self.parameters(statistics);
        let Some(exposure) = &scene.exposure else {
            return ToneMapping { parameters, gain: None };
        };
        let gain = exposure.gain_of(&photograph.luminance, photograph.camera.as_ref());
        self.exposed(exposure, parameters, &photograph.luminance, gain)
    }

    /// The tone mapping of what a camera sees, without a photograph of it: `together` are the measurements of all
    /// training photographs.
    pub(crate) fn tone_mapping_at(
        &self,
        scene: &SceneTone,
        camera: &Camera,
        together: &MeasuredPhotograph,
    ) -> ToneMapping {
        let parameters = self.parameters(scene.statistics.as_ref().unwrap_or(&together.statistics));
        match &scene.exposure {
            None => ToneMapping { parameters, gain: None },
            Some(exposure) => {
                let gain = exposure.gain_around(camera);
                self.exposed(exposure, parameters, &together.luminance, gain)
            }
        }
    }

    /// The tone mapping at a gain that follows from the exposure.
    fn exposed(
        &self,
        exposure: &Exposure,
        parameters: ToneParameters,
        luminance: &LuminanceHistogram,
        gain: f64,
    ) -> ToneMapping {
        let strength = match self.curve {
            ToneCurve::Auto | ToneCurve::Profile => gain,
            _ => self.strength(&parameters, luminance, gain),
        };
        // A profile applies to bright photographs, too.
        let weight = if self.profile.is_some() { 1.0 } else { exposure.weight() };
        let (white, weight) = ((1.0 / strength) as f32, weight as f32);
        let parameters = ToneParameters { white, gain: 1.0, weight, ..parameters };
        ToneMapping { parameters, gain: Some(gain) }
    }

    /// The factor on x that gives the curve the mean luminance of soft(x; gain).
    fn strength(&self, tone: &ToneParameters, luminance: &LuminanceHistogram, gain: f64) -> f64 {
        let target = luminance.mean_of(|y| super::soft(y, gain));
        let (curve, law) = (self.curve.constant(), [f64::from(tone.offset), 1.0]);
        let constants = tone.constants.map(f64::from);
        let mean = |strength: f64| {
            luminance.mean_of(|y| clamped(curve_at(curve, strength * y, law, &constants)))
        };
        solved(STRENGTHS, |strength| mean(strength) < target)
    }
}
