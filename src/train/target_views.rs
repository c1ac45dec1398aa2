//! Views scored against their targets: held-out views, and probes among the training views.

use glam::{DVec2, UVec2};
use nightsplat_core::camera::{Camera, TrainingFrame};
use nightsplat_photographs::dataset::{Dataset, View};
use nightsplat_photographs::image::{Image, Mask};
use nightsplat_photographs::metrics::{Scores, psnr_of_counted};
use nightsplat_photographs::tone::is_black;

use super::call::{Call, Scored};
use super::rendered::Rendered;
use super::views::{ImageKind, TrainingPhotograph, Views};
use crate::Result;
use crate::targets::Targets;
use crate::targets::pseudo_gt::PseudoGt;
use nightsplat_photographs::exposures::Affine;

/// Views with their targets.
#[derive(Debug, Default)]
pub(super) struct TargetViews(Vec<TargetView>);

/// A view in the frame, with its target and mask.
#[derive(Debug)]
struct TargetView {
    camera: Camera,
    target: Image,
    mask: Option<Mask>,
    /// The training photograph whose learned exposure the target has; `None` for the neutral exposure.
    photograph: Option<TrainingPhotograph>,
}

impl TargetViews {
    /// The views with their targets, made as for training views. Views that are entirely black or masked are left out,
    /// with a warning.
    pub(super) fn new<'a>(
        targets: &Targets,
        views: impl IntoIterator<Item = &'a View>,
        frame: &TrainingFrame,
    ) -> Result<Self> {
        let mut shown = vec![];
        for view in views {
            let Some(photograph) = targets.scene.source(view)? else { continue };
            let measured = view.measured(&photograph);
            if measured.luminance.pixel_count() == 0 || is_black(&measured.luminance) {
                let name = &view.name;
                tracing::warn!(
                    "view {name} is entirely black or masked: the model is not scored on it"
                );
                continue;
            }
            let target = targets.target_of(view, &photograph, || measured)?;
            let (camera, mask) = (frame.camera(&view.camera), view.mask.clone());
            shown.push(TargetView { camera, target, mask, photograph: None });
        }
        Ok(Self(shown))
    }

    /// `count` training views that cover the cameras, to measure the cost of a change. Views with more than `pixels`
    /// are resized to about that.
    pub(super) fn probes(
        targets: &Targets,
        dataset: &Dataset,
        frame: &TrainingFrame,
        [count, pixels]: [usize; 2],
    ) -> Result<Self> {
        let views: Vec<&View> =
            dataset.train_views().filter(|view| view.has_photograph()).collect();
        let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
        let mut probes = vec![];
        for at in Camera::covering(&cameras, count) {
            let Self(of_view) = Self::new(targets, [views[at]], frame)?;
            let photograph = Some(TrainingPhotograph(at));
            let shrunk = |view: TargetView| TargetView { photograph, ..view.shrunk(pixels) };
            probes.extend(of_view.into_iter().map(shrunk));
        }
        Ok(Self(probes))
    }

    /// Training views, evenly spread, with their targets.
    pub(super) fn of_training(views: &Views, pseudo_gt: &PseudoGt) -> Result<Self> {
        const MOST: usize = 8;
        let whole = views.whole();
        let some = whole.iter().step_by(whole.len().div_ceil(MOST).max(1)).map(|view| {
            let target = views.read(pseudo_gt, std::slice::from_ref(view), ImageKind::Targets)?;
            let UVec2 { x: width, y: height } = view.size();
            let target = Image { width, height, data: target.concat() };
            let (camera, photograph) = (view.patch.own_camera(), Some(view.photograph));
            Ok(TargetView { camera, target, mask: None, photograph })
        });
        Ok(Self(some.collect::<Result<_>>()?))
    }

    /// The mean PSNR, dB, of colours and output of `render` for each camera; `None` without views. `affines` are the
    /// exposures of the training photographs; where these are learned, a view of unknown exposure is compared after the
    /// least-squares gain and bias of each channel, since its brightness says nothing about the model. The call is that
    /// in which they are scored.
    pub(super) fn mean_psnr(
        &self,
        (call, what): (&mut Call, Scored),
        affines: &[Affine],
        mut render: impl FnMut(&Camera) -> Result<Rendered>,
    ) -> Result<Option<[f64; 2]>> {
        self.mean(call, what, |view| view.psnr(affines, &render(&view.camera)?))
    }

    /// The mean PSNR of the colours as [`Self::mean_psnr`], dB, and their mean detail.
    pub(super) fn mean_psnr_and_detail(
        &self,
        (call, what): (&mut Call, Scored),
        affines: &[Affine],
        mut render: impl FnMut(&Camera) -> Result<Rendered>,
    ) -> Result<Option<[f64; 2]>> {
        self.mean(call, what, |view| {
            let rendered = render(&view.camera)?;
            let [colors, _] = view.psnr(affines, &rendered)?;
            Ok([colors, view.detail(&rendered)?])
        })
    }

    /// The means of two scores over the views; `None` without views.
    fn mean(
        &self,
        call: &mut Call,
        what: Scored,
        scores_of: impl FnMut(&TargetView) -> Result<[f64; 2]>,
    ) -> Result<Option<[f64; 2]>> {
        let mut sums = [0.0; 2];
        for scores in call.scores(what, &self.0, scores_of)? {
            for (sum, score) in sums.iter_mut().zip(scores) {
                *sum += score;
            }
        }
        Ok((!self.0.is_empty()).then(|| sums.map(|sum| sum / self.0.len() as f64)))
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

impl TargetView {
    /// The PSNR, dB, of colours and output.
    fn psnr(&self, affines: &[Affine], rendered: &Rendered) -> Result<[f64; 2]> {
        let Self { target, mask, photograph, .. } = self;
        let exposure = photograph.and_then(|affine| affines.get(affine.0));
        let neutral = exposure.map(|affine| affine.inverse().applied(target));
        let target = neutral.as_ref().unwrap_or(target);
        let is_aligned = photograph.is_none() && !affines.is_empty();
        let mut scores = [0.0; 2];
        for (score, image) in scores.iter_mut().zip([&rendered.colors, rendered.output()]) {
            let aligned = is_aligned.then(|| Affine::least_squares(image, target)).transpose()?;
            let aligned = aligned.map(|affine| affine.applied(image));
            let image = clamped(aligned.as_ref().unwrap_or(image));
            *score = psnr_of_counted(&image, target, mask.as_ref())?;
        }
        Ok(scores)
    }

    /// The SSIM of the colours after the least-squares gain and bias of each channel.
    fn detail(&self, Rendered { colors, .. }: &Rendered) -> Result<f64> {
        let aligned = clamped(&Affine::least_squares(colors, &self.target)?.applied(colors));
        Ok(Scores::of_counted(&aligned, &self.target, self.mask.as_ref())?.ssim)
    }

    /// The view, resized to about this number of pixels if it has more.
    fn shrunk(self, pixels: usize) -> Self {
        let size = DVec2::new(self.camera.width.into(), self.camera.height.into());
        let scale = (pixels as f64 / size.element_product()).sqrt().min(1.0);
        let [width, height] =
            (scale * size).round().max(DVec2::ONE).to_array().map(|side| side as u32);
        let (camera, target) =
            (self.camera.resized(width, height), self.target.resized(width, height));
        Self { camera, target, ..self }
    }
}

fn clamped(image: &Image) -> Image {
    let data = image.data.iter().map(|value| value.clamp(0.0, 1.0)).collect();
    Image { data, ..*image }
}
