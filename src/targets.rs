//! The targets of views: the one place where a photograph's curve is chosen and applied.
//!
//! ```text
//! training photographs -> measurements ┐
//! settings of the curve ---------------┴-> SceneTone -> curve of each view, its inverse, the law of the scene
//! photograph of a view, its curve -> pseudo-GT pass -> target
//! pictures of another program --------------------> target
//! ```

pub mod pseudo_gt;
pub mod structure;

use nightsplat_core::{Error, Result};
use nightsplat_photographs::dataset::{Dataset, View};
use nightsplat_photographs::image::Image;
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{MeasuredPhotograph, ToneSettings};

use self::pseudo_gt::PseudoGt;
use crate::gpu::Gpu;

/// Makes the targets of views.
#[derive(Debug)]
pub struct Targets {
    /// The curves of the photographs.
    pub(crate) scene: SceneTone,
    /// What applies them.
    pub(crate) pseudo_gt: PseudoGt,
}

impl Targets {
    /// The targets of a dataset's views, whose training photographs are measured unless a law is recorded.
    pub fn new(gpu: &Gpu, tone: &ToneSettings, dataset: &Dataset) -> Result<Self> {
        Self::in_scene(gpu, SceneTone::for_dataset(tone, dataset)?)
    }

    /// The targets of a scene's views.
    pub fn in_scene(gpu: &Gpu, scene: SceneTone) -> Result<Self> {
        Ok(Self { pseudo_gt: PseudoGt::new(gpu, scene.settings())?, scene })
    }

    /// The target of a view that another program made, of its photograph's size; `None` if a curve makes the targets.
    pub(crate) fn external(&self, view: &View) -> Result<Option<Image>> {
        match self.scene.settings().targets() {
            None => Ok(None),
            Some(folder) => view.external_target()?.map(Some).ok_or_else(|| {
                Error::input(folder, format!("has no target for the photograph {}", view.name))
            }),
        }
    }

    /// The target of a view, of its camera's size; `None` without a photograph.
    pub fn target(&self, view: &View) -> Result<Option<Image>> {
        let photograph = self.scene.source(view)?;
        let target = photograph
            .map(|photograph| self.target_of(view, &photograph, || view.measured(&photograph)));
        target.transpose()
    }

    /// The target of a photograph with these measurements, of its own size.
    pub(crate) fn tone_mapped(
        &self,
        photograph: &Image,
        measured: &MeasuredPhotograph,
    ) -> Result<Image> {
        self.pseudo_gt.tone_mapped(photograph, &self.scene.curve_of(measured))
    }

    /// The target of a view with this photograph and its measurements, of its camera's size.
    pub(crate) fn target_of(
        &self,
        view: &View,
        photograph: &Image,
        measured: impl FnOnce() -> MeasuredPhotograph,
    ) -> Result<Image> {
        let target = match self.external(view)? {
            Some(target) => target,
            None => {
                let curve = self.scene.curve_for(view, measured)?;
                self.pseudo_gt.tone_mapped(photograph, &curve)?
            }
        };
        Ok(target.resized(view.camera.width, view.camera.height))
    }
}
