//! Hidden pixels of the training views. Where one is hidden the render is taken for its target, so that no term sees a
//! difference there, and nothing of the gradient goes back: neither to the Gaussians nor to what density control counts.

use glam::UVec2;

use super::views::Views;
use crate::Result;
use crate::dataset::Dataset;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{ToneParameters, mask_gradient, mask_render};
use crate::scene::COLOR_CHANNELS;

/// The masks of the views that have one, and what applies them; a view without one costs nothing.
#[derive(Debug)]
pub(super) struct Masks {
    /// By the number of the view, (H, W).
    weights: Vec<Option<Buffer<f32>>>,
    /// None where no view has one.
    kernels: Option<Kernels>,
}

#[derive(Debug)]
struct Kernels {
    render: Pipeline<mask_render::Kernel>,
    gradient: Pipeline<mask_gradient::Kernel>,
    /// (3, H, W) of the largest masked view.
    shown: Buffer<f32>,
}

impl Masks {
    /// The masks of the dataset's views at the sizes that they are trained on; `tone_curve` is a `CURVE_*`.
    ///
    /// # Errors
    /// The device is out of memory.
    pub(super) fn new(
        gpu: &Gpu,
        dataset: &Dataset,
        views: &Views,
        tone_curve: u32,
    ) -> Result<Self> {
        let (mut weights, mut largest) = (vec![], 0);
        for view in views.all() {
            let size = view.size();
            let own = dataset.views.iter().find(|own| own.name == view.name);
            let mask = own.and_then(|own| own.mask.as_ref());
            let mask = mask.map(|mask| gpu.buffer("mask", &mask.resized(size.x, size.y).weights));
            largest = largest.max(if mask.is_some() { value_count(size) } else { 0 });
            weights.push(mask.transpose()?);
        }
        let kernels = if largest > 0 {
            Some(Kernels {
                render: gpu.pipeline(&mask_render::Constants { tone_curve })?,
                gradient: gpu.pipeline(&mask_gradient::Constants {})?,
                shown: gpu.uninit("shown", largest)?,
            })
        } else {
            None
        };
        Ok(Self { weights, kernels })
    }

    /// What the loss is to see of `render`, (3, H, W): itself, or where pixels are hidden their target.
    ///
    /// # Errors
    /// The pass cannot be recorded.
    pub(super) fn shown<'a>(
        &'a mut self,
        pass: &mut Recorder<'_>,
        view: usize,
        size: UVec2,
        render: &'a Buffer<f32>,
        (low, tone): (&Buffer<f32>, &Buffer<ToneParameters>),
    ) -> Result<&'a Buffer<f32>> {
        let weights = self.weights.get(view).and_then(Option::as_ref);
        let (Some(weights), Some(kernels)) = (weights, &mut self.kernels) else {
            return Ok(render);
        };
        let value_count = value_count(size) as u32;
        pass.dispatch(
            &kernels.render,
            &mask_render::Params { value_count, pixel_count: size.x * size.y },
            mask_render::Buffers { weights, render, low, tone, shown: &mut kernels.shown },
            Threads::Exactly([value_count, 1, 1]),
        )?;
        Ok(&kernels.shown)
    }

    /// Makes of dL/d shown, in every one of `channels` channels, dL/d render.
    ///
    /// # Errors
    /// The pass cannot be recorded.
    pub(super) fn hide(
        &self,
        pass: &mut Recorder<'_>,
        view: usize,
        (size, channels): (UVec2, usize),
        d_render: &mut Buffer<f32>,
    ) -> Result<()> {
        let weights = self.weights.get(view).and_then(Option::as_ref);
        let (Some(weights), Some(kernels)) = (weights, &self.kernels) else { return Ok(()) };
        let pixel_count = size.x * size.y;
        let value_count = channels as u32 * pixel_count;
        pass.dispatch(
            &kernels.gradient,
            &mask_gradient::Params { value_count, pixel_count },
            mask_gradient::Buffers { weights, d_render },
            Threads::Exactly([value_count, 1, 1]),
        )
    }
}

/// Of the colours of a view.
fn value_count(size: UVec2) -> usize {
    COLOR_CHANNELS * size.x as usize * size.y as usize
}
