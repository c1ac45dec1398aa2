//! Masks of the training views. At masked pixels, the render is replaced by its target: no term has a difference or a
//! gradient there, neither for the Gaussians nor for the statistics of density control.

use glam::UVec2;
use nightsplat_core::camera::Camera;
use nightsplat_models::gaussians::COLOR_CHANNELS;
use nightsplat_photographs::dataset::Dataset;

use super::views::{TrainingView, Views};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{mask_gradient, mask_render};

/// The masks of the views and the kernels that apply them; a view without a mask costs nothing.
#[derive(Debug)]
pub(super) struct Masks {
    /// By the training view; (H, W).
    weights: Vec<Option<Buffer<f32>>>,
    /// `None` if no view has a mask.
    masking: Option<Masking>,
}

impl Masks {
    /// The masks of the dataset's views at the sizes that they are trained on.
    pub(super) fn new(gpu: &Gpu, dataset: &Dataset, views: &Views) -> Result<Self> {
        let (mut weights, mut largest) = (vec![], 0);
        for view in views.all() {
            let (size, Camera { width, height, .. }) = (view.size(), view.patch.camera);
            let mask = dataset.views[view.in_dataset.0].mask.as_ref();
            let mask = mask.map(|mask| mask.resized(width, height));
            let mask = mask.map(|mask| gpu.buffer("mask", &view.patch.cut(&mask.weights)));
            largest = largest.max(if mask.is_some() { value_count(size) } else { 0 });
            weights.push(mask.transpose()?);
        }
        let masking = (largest > 0).then(|| Masking::new(gpu, largest));
        Ok(Self { weights, masking: masking.transpose()? })
    }

    /// Whether no view has a mask.
    pub(super) fn is_empty(&self) -> bool {
        self.masking.is_none()
    }

    /// The mask of a view, (H, W).
    pub(super) fn of_view(&self, view: TrainingView) -> Option<&Buffer<f32>> {
        self.weights.get(view.0)?.as_ref()
    }

    /// The image for the loss, (3, H, W): `render`, with the target at masked pixels.
    pub(super) fn shown<'a>(
        &'a mut self,
        pass: &mut Recorder<'_>,
        view: TrainingView,
        size: UVec2,
        render: &'a Buffer<f32>,
        target: &Buffer<f32>,
    ) -> Result<&'a Buffer<f32>> {
        let weights = self.weights.get(view.0).and_then(Option::as_ref);
        match weights.zip(self.masking.as_mut()) {
            Some((weights, masking)) => masking.shown(pass, weights, size, render, target),
            None => Ok(render),
        }
    }

    /// Turns dL/d shown into dL/d render, in each of `channels` channels.
    pub(super) fn hide(
        &self,
        pass: &mut Recorder<'_>,
        view: TrainingView,
        size: UVec2,
        channels: usize,
        d_render: &mut Buffer<f32>,
    ) -> Result<()> {
        match self.of_view(view).zip(self.masking.as_ref()) {
            Some((weights, masking)) => masking.hide(pass, weights, size, channels, d_render),
            None => Ok(()),
        }
    }
}

/// The kernels that apply a mask to an image before it is compared with a target.
#[derive(Debug)]
pub(super) struct Masking {
    render: Pipeline<mask_render::Kernel>,
    gradient: Pipeline<mask_gradient::Kernel>,
    /// The masked image; (3, H, W) of the largest view.
    shown: Buffer<f32>,
}

impl Masking {
    /// Kernels for images of at most `values` values.
    pub(super) fn new(gpu: &Gpu, values: usize) -> Result<Self> {
        Ok(Self {
            render: gpu.pipeline(&mask_render::Constants {})?,
            gradient: gpu.pipeline(&mask_gradient::Constants {})?,
            shown: gpu.uninit("shown", values)?,
        })
    }

    /// `render`, (3, H, W), with the target at pixels that `weights`, (H, W), mask.
    pub(super) fn shown(
        &mut self,
        pass: &mut Recorder<'_>,
        weights: &Buffer<f32>,
        size: UVec2,
        render: &Buffer<f32>,
        target: &Buffer<f32>,
    ) -> Result<&Buffer<f32>> {
        let value_count = value_count(size) as u32;
        pass.dispatch(
            &self.render,
            &mask_render::Params { value_count, pixel_count: size.x * size.y },
            mask_render::Buffers {
                weights: weights.slice(),
                render: render.slice(),
                target: target.slice(),
                shown: self.shown.slice_mut(),
            },
            Threads::Exactly([value_count, 1, 1]),
        )?;
        Ok(&self.shown)
    }

    /// Turns dL/d shown into dL/d render, in each of `channels` channels.
    pub(super) fn hide(
        &self,
        pass: &mut Recorder<'_>,
        weights: &Buffer<f32>,
        size: UVec2,
        channels: usize,
        d_render: &mut Buffer<f32>,
    ) -> Result<()> {
        let pixel_count = size.x * size.y;
        let value_count = channels as u32 * pixel_count;
        pass.dispatch(
            &self.gradient,
            &mask_gradient::Params { value_count, pixel_count },
            mask_gradient::Buffers { weights: weights.slice(), d_render: d_render.slice_mut() },
            Threads::Exactly([value_count, 1, 1]),
        )
    }
}

/// The number of colour values of a view.
fn value_count(size: UVec2) -> usize {
    COLOR_CHANNELS * size.x as usize * size.y as usize
}
