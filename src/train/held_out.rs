//! Training views that are kept from training: how well the model shows their targets says when it has converged.

use serde::{Deserialize, Serialize};

use super::Trainer;
use super::views::lifted_from;
use crate::camera::Camera;
use crate::dataset::{Dataset, Split};
use crate::image::Image;
use crate::metrics::psnr;
use crate::pseudo_gt::PseudoGt;
use crate::tone::Scene;
use crate::{Error, Result};

/// When a run, or a part of it, ends before its last step. The scores are against targets, never against references.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StopConfig {
    /// So many training views are kept from training, an eighth of them at most; 0: none, and no run ends early.
    pub views: usize,
    /// They are scored every so many steps.
    pub every: u64,
    /// The run ends once two scores in a row are not better than the best before by so many dB.
    pub gain: f64,
    /// Growth ends once four rounds of density control gain less than so many dB for each doubling of the Gaussians; 0: it
    /// goes on to its last step.
    pub growth_gain: f64,
    /// The SH degree rises no further, and falls back, once the one in use gains less than so many dB; 0: it rises always.
    pub degree_gain: f64,
}

impl Default for StopConfig {
    fn default() -> Self {
        Self { views: 0, every: 250, gain: 0.05, growth_gain: 0.0, degree_gain: 0.0 }
    }
}

impl StopConfig {
    /// Whether a run with these scores, in order, is to end.
    pub fn has_converged(&self, scores: &[f64]) -> bool {
        const PATIENCE: usize = 2;
        let Some(before) = scores.len().checked_sub(PATIENCE).filter(|&before| before > 0) else {
            return false;
        };
        let best = |of: &[f64]| of.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        best(&scores[before..]) < best(&scores[..before]) + self.gain
    }

    /// # Errors
    /// [`Error::Usage`] names a value that makes no sense.
    pub(super) fn check(&self) -> Result<()> {
        let gain = |name, gain: f64| (name, gain, gain.is_finite() && gain >= 0.0, "0 or more");
        let rules = [
            ("stop.every", self.every as f64, self.every >= 1, "at least 1"),
            gain("stop.gain", self.gain),
            gain("stop.growth_gain", self.growth_gain),
            gain("stop.degree_gain", self.degree_gain),
        ];
        match rules.into_iter().find(|(_, _, holds, _)| !holds) {
            Some((name, value, _, rule)) => {
                Err(Error::Usage(format!("{name} is {value}; it must be {rule}")))
            }
            None => Ok(()),
        }
    }
}

/// Cameras, and what they are to show.
#[derive(Debug, Default)]
pub(super) struct HeldOut(Vec<(Camera, Image)>);

impl HeldOut {
    /// The held-out views of a dataset with their targets, made as those of its training views.
    pub(super) fn new(pseudo_gt: &mut PseudoGt, dataset: &Dataset, scene: &Scene) -> Result<Self> {
        let settings = pseudo_gt.settings().clone();
        let mut views = vec![];
        for view in dataset.views.iter().filter(|view| view.split == Split::HeldOut) {
            let Some(image) = &view.image else { continue };
            let whole = lifted_from(view, image, settings.lift_first)?;
            let lift = settings.lift(scene, &pseudo_gt.measure(&whole.data)?);
            let target = pseudo_gt.lifted(&whole, &lift)?;
            views.push((view.camera, target.resized(image.width, image.height)));
        }
        Ok(Self(views))
    }
}

impl Trainer {
    /// The mean PSNR, dB, of what the model shows of the held-out views against their targets; none where there are none.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn held_out_psnr(&mut self) -> Result<Option<f64>> {
        self.held_out_psnr_of_degree(self.sh_degree(self.step))
    }

    /// As [`Trainer::held_out_psnr`], with the colours of an SH degree.
    pub(super) fn held_out_psnr_of_degree(&mut self, sh_degree: u32) -> Result<Option<f64>> {
        let views = std::mem::take(&mut self.held_out);
        let scores = views.0.iter().map(|(camera, target)| {
            let mut shown = self.render_of_degree(camera, sh_degree)?.output().clone();
            shown.data.iter_mut().for_each(|value| *value = value.clamp(0.0, 1.0));
            psnr(&shown, target)
        });
        let scores = scores.collect::<Result<Vec<f64>>>();
        self.held_out = views;
        let scores = scores?;
        let mean = scores.iter().sum::<f64>() / scores.len() as f64;
        Ok((!scores.is_empty()).then_some(mean))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_ends_once_two_scores_in_a_row_gain_too_little() {
        let stop = StopConfig { gain: 0.05, ..StopConfig::default() };
        for (scores, ends) in [
            (&[][..], false),
            (&[20.0, 20.0], false),
            (&[20.0, 20.02, 20.04], true),
            (&[20.0, 19.0, 20.06], false),
            (&[20.0, 20.5, 20.5, 20.5], true),
            (&[20.0, 21.0, 20.0, 20.9], true),
            (&[20.0, 20.1, 20.2, 20.3, 20.4], false),
        ] {
            assert_eq!(stop.has_converged(scores), ends, "{scores:?}");
        }
    }
}
