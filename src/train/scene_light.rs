//! The light of a scene's photographs: the inverse of the curves that made the targets.

use super::measuring::{measured, measured_of, photographs, scene_of_measured};
use crate::Result;
use crate::camera::Camera;
use crate::photographs::dataset::{Dataset, View};
use crate::photographs::image::{Image, linear_from_srgb};
use crate::photographs::pseudo_gt::PseudoGt;
use crate::photographs::tone::{
    InverseTone, LuminanceHistogram, MeasuredPhotograph, SceneLaw, SceneTone, Statistics,
    ToneMapping, ToneSettings,
};
use crate::splats::lamp::Lamp;

/// The tone law of a lamp's colours; [`Lamp`] has its formula.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Encoding {
    /// The target of no light.
    pub(super) black: f64,
    /// d ln(target - black) / d ln light near black.
    pub(super) slope: f64,
    /// The target above black to which it saturates; 0: it does not.
    pub(super) reach: f64,
}

impl Encoding {
    /// That which is nearest to (ln light, target above black) in the logarithm, by least squares.
    fn fitted(black: f64, known: &[[f64; 2]]) -> Self {
        /// The reaches that are tried, over the largest target: a law beyond the last one is as good as a power.
        const REACHES: i32 = 24;
        /// Of a law that is flat, and of one that is steeper than light.
        const SLOPES: [f64; 2] = [0.1, 2.0];
        let largest = known.iter().fold(0.0_f64, |largest, own| largest.max(own[1]));
        let reaches = (0..REACHES).map(|k| largest * (1.0 + 0.02 * 1.4_f64.powi(k)));
        let fit = |reach: f64| {
            let x =
                |above: f64| if reach == 0.0 { above } else { -reach * (-above / reach).ln_1p() };
            let points = known.iter().map(|&[light, above]| [light, x(above).ln()]);
            let (slope, residual) = line(&points.collect::<Vec<_>>());
            (residual, Self { black, slope, reach })
        };
        let all = [0.0].into_iter().chain(reaches).map(fit);
        let best =
            all.filter(|(residual, _)| residual.is_finite()).min_by(|a, b| a.0.total_cmp(&b.0));
        let usual = Self { black, slope: Lamp::AT_CAMERA.slope, reach: 0.0 };
        let own = best.map_or(usual, |(_, own)| own);
        Self { slope: own.slope.clamp(SLOPES[0], SLOPES[1]), ..own }
    }
}

/// The slope of the line of least squares through points, and the sum of its squared residuals.
fn line(points: &[[f64; 2]]) -> (f64, f64) {
    let mean = |axis: usize| points.iter().map(|own| own[axis]).sum::<f64>() / points.len() as f64;
    let middle = [0, 1].map(mean);
    let product = |a: usize, b: usize| {
        points.iter().map(|own| (own[a] - middle[a]) * (own[b] - middle[b])).sum::<f64>()
    };
    let slope = product(0, 1) / product(0, 0);
    (slope, product(1, 1) - slope * product(0, 1))
}

/// From the values of a model to those of its photographs.
#[derive(Clone, Debug)]
pub struct SceneLight {
    settings: ToneSettings,
    scene: SceneTone,
    training: Vec<MeasuredPhotograph>,
    /// All training photographs as one.
    together: MeasuredPhotograph,
}

impl SceneLight {
    /// Measures the training photographs.
    pub fn of(settings: &ToneSettings, dataset: &Dataset) -> Result<Self> {
        let training = measured(settings, dataset)?;
        let scene = scene_of_measured(settings, dataset, &training)?;
        let mut luminance = LuminanceHistogram::default();
        training.iter().for_each(|one| luminance.add(&one.luminance));
        let statistics: Vec<Statistics> = training.iter().map(|one| one.statistics).collect();
        let statistics = Statistics::mean_of(&statistics).unwrap_or_default();
        let together = MeasuredPhotograph { statistics, luminance, camera: None };
        Ok(Self { settings: settings.clone(), scene, training, together })
    }

    /// The scene's tone.
    pub(super) fn scene(&self) -> &SceneTone {
        &self.scene
    }

    /// The tone mapping of each training photograph of the dataset.
    pub(super) fn tone_mappings(&self, dataset: &Dataset) -> Result<Vec<ToneMapping>> {
        let mapping = |((_, view), own): ((usize, &View), &MeasuredPhotograph)| {
            let recorded = self.scene.recorded_mapping(&view.name)?;
            Ok(recorded.unwrap_or_else(|| self.settings.tone_mapping(&self.scene, own)))
        };
        photographs(dataset).zip(&self.training).map(mapping).collect()
    }

    /// The inverse for a view: that of the curve of its photograph; of a view without one, [`SceneLight::at`] its
    /// camera.
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
    pub fn of_scene(&self) -> Result<InverseTone> {
        let mapping = self.settings.tone_mapping(&self.scene, &self.together);
        InverseTone::new(&self.settings, &mapping.parameters)
    }

    /// The curve of the whole scene, whose inverse is [`SceneLight::of_scene`].
    pub fn law(&self) -> Result<SceneLaw> {
        let mapping = self.settings.tone_mapping(&self.scene, &self.together);
        SceneLaw::of(&self.settings, &mapping.parameters)
    }

    /// The tone law of grey, fitted to the targets of all photographs together; light is linear.
    pub(super) fn encoding(&self, pseudo_gt: &PseudoGt) -> Result<Encoding> {
        /// The shares of the pixels that are darker than the greys that it is fitted to.
        const SHARES: [f64; 9] = [0.05, 0.1, 0.25, 0.4, 0.5, 0.6, 0.75, 0.9, 0.99];
        let luminance = &self.together.luminance;
        let mut greys = SHARES.map(|share| luminance.quantile(share) as f32).to_vec();
        greys.retain(|&grey| grey > 0.0);
        greys.dedup();
        if greys.len() < 2 {
            let mean = luminance.mean() as f32;
            greys = vec![0.5 * mean, mean];
        }
        let row: Vec<f32> = [0.0].into_iter().chain(greys.iter().copied()).collect();
        let grey = Image { width: row.len() as u32, height: 1, data: row.repeat(3) };
        let mapping = self.settings.tone_mapping(&self.scene, &self.together);
        let target = pseudo_gt.tone_mapped(&grey, &mapping)?.data;
        let black = f64::from(target[0]);
        let light = |grey: f32| f64::from(linear_from_srgb(grey)).ln();
        let above = target[1..].iter().map(|&value| f64::from(value) - black);
        let known: Vec<[f64; 2]> = (greys.iter().map(|&grey| light(grey)).zip(above))
            .filter(|&(light, above)| light.is_finite() && above > 0.0 && above + black < 0.999)
            .map(|(light, above)| [light, above])
            .collect();
        Ok(Encoding::fitted(black, &known))
    }

    /// The inverse for a camera, at the exposure of the photographs around it: all cameras share one unit of light, as
    /// far as the photographs share an exposure.
    pub fn at(&self, camera: &Camera) -> Result<InverseTone> {
        let mapping = self.settings.tone_mapping_at(&self.scene, camera, &self.together);
        InverseTone::new(&self.settings, &mapping.parameters)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tone_law_that_saturates_is_found_and_a_power_does_not() {
        let lights = (0..9).map(|k| 0.002 * 2.0_f64.powi(k));
        let law = |reach: f64| {
            let bent = lights.clone().map(|light| (light, 1.8 * light.powf(0.6)));
            let target = |x: f64| if reach == 0.0 { x } else { reach * (1.0 - (-x / reach).exp()) };
            bent.map(|(light, x)| [light.ln(), target(x)]).collect::<Vec<_>>()
        };
        let own = Encoding::fitted(0.07, &law(0.8));
        assert!((own.slope - 0.6).abs() < 0.02 && (own.reach - 0.8).abs() < 0.05, "{own:?}");
        let power = Encoding::fitted(0.07, &law(0.0));
        assert!((power.slope - 0.6).abs() < 1e-9 && power.reach == 0.0, "{power:?}");
    }

    #[test]
    fn a_law_of_which_hardly_anything_is_known_has_the_slope_of_a_display() {
        let usual = Encoding { black: 0.0, slope: Lamp::AT_CAMERA.slope, reach: 0.0 };
        for known in [&[][..], &[[0.0, 0.5]], &[[0.0, 0.5], [0.0, 0.5]]] {
            assert_eq!(Encoding::fitted(0.0, known), usual, "{known:?}");
        }
    }
}
