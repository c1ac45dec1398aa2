//! Training views that are kept from training: how well the model shows their targets says when it has converged.

use serde::{Deserialize, Serialize};

use super::Trainer;
use super::terms::NetworkTerms;
use super::views::{lifted_from, measured};
use crate::camera::{Camera, Frame};
use crate::dataset::{Dataset, Split, View};
use crate::exposure::Exposures;
use crate::gpu::Gpu;
use crate::image::{Image, Mask};
use crate::metrics::psnr_of_counted;
use crate::pseudo_gt::PseudoGt;
use crate::tone::{Scene, ToneSettings};
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
    /// What is done about a view whose loss or gradient is not finite.
    #[serde(skip_serializing_if = "NotFinite::is_stop")]
    pub not_finite: NotFinite,
    /// The SH degree rises no further, and falls back, once the one in use gains less than so many dB; 0: it rises always.
    pub degree_gain: f64,
}

/// What is done about a view whose loss or gradient is NaN or infinite. The step that finds it changes nothing, either way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NotFinite {
    /// The run ends with an error that names step, view and term.
    #[default]
    Stop,
    /// The view is trained on no more.
    SkipView,
}

impl NotFinite {
    #[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
    fn is_stop(&self) -> bool {
        *self == Self::Stop
    }
}

impl Default for StopConfig {
    fn default() -> Self {
        Self {
            views: 0,
            every: 250,
            gain: 0.05,
            growth_gain: 0.0,
            not_finite: NotFinite::Stop,
            degree_gain: 0.0,
        }
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

/// Cameras in the frame, and what they are to show.
#[derive(Debug, Default)]
pub(super) struct HeldOut(Vec<Shown>);

/// What a camera is to show, where it counts.
#[derive(Debug)]
struct Shown {
    camera: Camera,
    target: Image,
    mask: Option<Mask>,
}

impl HeldOut {
    /// The held-out views of a dataset with their targets, made as those of its training views.
    pub(super) fn new(
        pseudo_gt: &mut PseudoGt,
        dataset: &Dataset,
        frame: &Frame,
        scene: &Scene,
    ) -> Result<Self> {
        let mut shown = vec![];
        for view in dataset.views.iter().filter(|view| view.split == Split::HeldOut) {
            if let Some(target) = target(pseudo_gt, view, scene)? {
                let camera = frame.camera(&view.camera);
                shown.push(Shown { camera, target, mask: view.mask.clone() });
            }
        }
        Ok(Self(shown))
    }
}

/// The target of a view, made as those of the training views are; none without a photograph.
fn target(pseudo_gt: &mut PseudoGt, view: &View, scene: &Scene) -> Result<Option<Image>> {
    let settings = pseudo_gt.settings().clone();
    let Some(photograph) = lifted_from(view, settings.lift_first)? else { return Ok(None) };
    let lift = settings.lift(scene, &pseudo_gt.measure(&view.counted(&photograph))?);
    let target = pseudo_gt.lifted(&photograph, &lift)?;
    Ok(Some(target.resized(view.camera.width, view.camera.height)))
}

/// The targets that the test views would have were they trained on: what `tone` makes of their photographs in the scene of
/// the training photographs.
#[derive(Debug)]
pub struct TestTargets {
    pseudo_gt: PseudoGt,
    scene: Scene,
}

impl TestTargets {
    /// Measures the training photographs.
    ///
    /// # Errors
    /// Every training photograph is as good as black where their exposure is asked for; a photograph can no longer be read;
    /// the device is out of memory or lost.
    pub fn new(gpu: &Gpu, tone: &ToneSettings, dataset: &Dataset) -> Result<Self> {
        let mut pseudo_gt = PseudoGt::new(gpu, tone)?;
        let (scene, _) = measured(&mut pseudo_gt, dataset)?;
        Ok(Self { pseudo_gt, scene })
    }

    /// That of a view, of its camera's size; none where it has no photograph.
    ///
    /// # Errors
    /// The photograph can no longer be read, or the device is out of memory or lost.
    pub fn of(&mut self, view: &View) -> Result<Option<Image>> {
        target(&mut self.pseudo_gt, view, &self.scene)
    }
}

impl Trainer {
    /// The mean PSNR, dB, of what the Gaussians show of the held-out views against their targets; none where there are none.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn held_out_psnr(&mut self) -> Result<Option<f64>> {
        self.held_out_psnr_of_degree(self.sh_degree(self.step))
    }

    /// As [`Trainer::held_out_psnr`], with the colours of an SH degree.
    pub(super) fn held_out_psnr_of_degree(&mut self, sh_degree: u32) -> Result<Option<f64>> {
        let [colors, _] = self.psnr_of_held_out(sh_degree)?;
        Ok(colors)
    }

    /// The mean PSNR, dB, of R_0 and of what the model shows, R_K where it has a denoiser; none where no view is held out.
    fn psnr_of_held_out(&mut self, sh_degree: u32) -> Result<[Option<f64>; 2]> {
        let views = std::mem::take(&mut self.held_out);
        let scores = self.scores(&views.0, sh_degree);
        self.held_out = views;
        scores
    }

    fn scores(&mut self, views: &[Shown], sh_degree: u32) -> Result<[Option<f64>; 2]> {
        let mut sums = [0.0; 2];
        for Shown { camera, target, mask } in views {
            let shown = self.render_of_degree(camera, sh_degree)?;
            let clamped = |image: &Image| {
                let data = image.data.iter().map(|value| value.clamp(0.0, 1.0)).collect();
                Image { data, ..*image }
            };
            let psnr = |image: &Image| psnr_of_counted(&clamped(image), target, mask.as_ref());
            sums[0] += psnr(&shown.colors)?;
            sums[1] += psnr(shown.output())?;
        }
        Ok(sums.map(|sum| (!views.is_empty()).then(|| sum / views.len() as f64)))
    }

    /// Leaves out what the denoiser has learned where it shows the held-out views, or without any some of the training views,
    /// hardly better than R_0 does: it is the identity again. For the end of a run, not on its way; the paper's stays.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn leave_out_what_gains_nothing(&mut self) -> Result<()> {
        /// Less on few views, dB, is chance.
        const LEAST_GAIN: f64 = 0.05;
        if !self.networks.as_ref().is_some_and(NetworkTerms::follow_target) {
            return Ok(());
        }
        let sh_degree = self.sh_degree(self.step);
        let scores = match self.psnr_of_held_out(sh_degree)? {
            [None, _] => {
                let views = self.some_training_views()?;
                self.scores(&views, sh_degree)?
            }
            scores => scores,
        };
        let [Some(colors), Some(denoised)] = scores else { return Ok(()) };
        let gain = denoised - colors;
        if gain >= LEAST_GAIN {
            tracing::info!("the denoiser gains {gain:.2} dB on targets");
            return Ok(());
        }
        tracing::info!("the denoiser gains nothing on targets ({gain:.2} dB): it is left out");
        match self.networks.as_mut().and_then(|terms| terms.networks.denoiser.as_mut()) {
            Some(denoiser) => denoiser.become_identity(),
            None => Ok(()),
        }
    }

    /// Training views, evenly spread, with their targets at the neutral exposure.
    fn some_training_views(&self) -> Result<Vec<Shown>> {
        const MOST: usize = 8;
        let affines = self.exposures.as_ref().map(Exposures::affines).transpose()?;
        let views = self.views.whole();
        let mut some = vec![];
        for view in views.iter().step_by(views.len().div_ceil(MOST).max(1)) {
            let target = view.image(&self.gpu, &*view.kept_target(&self.gpu)?)?;
            let exposure = affines.as_ref().and_then(|affines| affines.get(view.place));
            let neutral = exposure.map_or(target.clone(), |own| own.inverse().applied(&target));
            some.push(Shown { camera: view.patch.pinhole(), target: neutral, mask: None });
        }
        Ok(some)
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
