//! The light of a scene's photographs: the inverse of the curves that made the targets.

use super::measuring::{measured, measured_of, recorded};
use crate::Result;
use crate::camera::Camera;
use crate::photographs::dataset::{Dataset, View};
use crate::photographs::image::{Image, linear_from_srgb, srgb_from_linear};
use crate::photographs::pseudo_gt::PseudoGt;
use crate::photographs::tone::{
    InverseTone, LuminanceHistogram, MeasuredPhotograph, SceneLaw, SceneTone, Statistics,
    ToneSettings,
};
use crate::splats::lamp::Lamp;

/// From the values of a model to those of its photographs.
#[derive(Clone, Debug)]
pub struct SceneLight {
    settings: ToneSettings,
    scene: SceneTone,
    /// All training photographs as one.
    together: MeasuredPhotograph,
}

impl SceneLight {
    /// Measures the training photographs.
    ///
    /// # Errors
    /// Every photograph is black and their exposure is needed, or one can no longer be read.
    pub fn of(settings: &ToneSettings, dataset: &Dataset) -> Result<Self> {
        let (scene, training) = measured(settings, dataset)?;
        let mut luminance = LuminanceHistogram::default();
        training.iter().for_each(|one| luminance.add(&one.luminance));
        let scene = match &settings.law {
            Some(path) => recorded(path, settings)?,
            None => scene,
        };
        let statistics: Vec<Statistics> = training.iter().map(|one| one.statistics).collect();
        let statistics = Statistics::mean_of(&statistics).unwrap_or_default();
        let together = MeasuredPhotograph { statistics, luminance, camera: None };
        Ok(Self { settings: settings.clone(), scene, together })
    }

    /// The inverse for a view: that of the curve of its photograph; of a view without one, [`SceneLight::at`] its
    /// camera.
    ///
    /// # Errors
    /// The curve has no inverse, or the photograph can no longer be read.
    pub fn of_view(&self, view: &View) -> Result<InverseTone> {
        if let Some(mapping) = self.scene.recorded_mapping(&view.name)? {
            return InverseTone::new(&self.settings, &mapping.parameters);
        }
        match measured_of(view, self.settings.full_resolution)? {
            Some(photograph) => {
                let mapping = self.settings.tone_mapping(&self.scene, &photograph);
                InverseTone::new(&self.settings, &mapping.parameters)
            }
            None => self.at(&view.camera),
        }
    }

    /// The inverse of the whole scene, at the exposure of all photographs together.
    ///
    /// # Errors
    /// The curve has no inverse.
    pub fn of_scene(&self) -> Result<InverseTone> {
        let mapping = self.settings.tone_mapping(&self.scene, &self.together);
        InverseTone::new(&self.settings, &mapping.parameters)
    }

    /// The curve of the whole scene, whose inverse is [`SceneLight::of_scene`].
    ///
    /// # Errors
    /// The curve has no inverse, or is a table.
    pub fn law(&self) -> Result<SceneLaw> {
        let mapping = self.settings.tone_mapping(&self.scene, &self.together);
        SceneLaw::of(&self.settings, &mapping.parameters)
    }

    /// The target of no light, and the slope of the tone law around the median of the targets, for all photographs
    /// together: d ln(target - black) / d ln light of grey, light being linear.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub(super) fn encoding(&self, pseudo_gt: &PseudoGt) -> Result<(f64, f64)> {
        /// Of the light between which the slope is taken: a stop below and above.
        const STOP: f32 = 2.0;
        /// Of a law that is flat there, and of one that is steeper than light.
        const BOUNDS: [f64; 2] = [0.1, 2.0];
        let luminance = &self.together.luminance;
        // A curve does not decrease: the median of its values is the value of the median.
        let median = Some(luminance.quantile(0.5)).filter(|&median| median > 0.0);
        let median = median.unwrap_or_else(|| luminance.mean()) as f32;
        let light = linear_from_srgb(median);
        let lights = [light / STOP, light * STOP];
        let [dim, bright] = lights.map(srgb_from_linear);
        let grey = Image { width: 3, height: 1, data: [0.0, dim, bright].repeat(3) };
        let mapping = self.settings.tone_mapping(&self.scene, &self.together);
        let target = pseudo_gt.tone_mapped(&grey, &mapping)?.data;
        let rise = |[dim, bright]: [f32; 2]| f64::from(bright / dim).ln();
        let above = [target[1], target[2]].map(|value| value - target[0]);
        let slope = rise(above) / rise(lights);
        let [least, most] = BOUNDS;
        let slope =
            if slope.is_finite() { slope.clamp(least, most) } else { Lamp::AT_CAMERA.slope };
        Ok((target[0].into(), slope))
    }

    /// The inverse for a camera, at the exposure of the photographs around it: all cameras share one unit of light, as
    /// far as the photographs share an exposure.
    ///
    /// # Errors
    /// The curve has no inverse.
    pub fn at(&self, camera: &Camera) -> Result<InverseTone> {
        let mapping = self.settings.tone_mapping_at(&self.scene, camera, &self.together);
        InverseTone::new(&self.settings, &mapping.parameters)
    }
}
