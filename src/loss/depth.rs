//! The depth term: a plane of the render correlates with an estimated depth, over the view and over random boxes.
//!
//! P(a, b) = 1 - mean(a^ b^), a^ = (a - mean a) / (s + 1e-6), s^2 the unbiased variance of a: the estimate's scale
//! and offset do not matter.

use std::sync::Arc;

use glam::UVec2;
use nightsplat_core::random::Stream;
use nightsplat_models::gaussians::Feature;

use super::log::{LogSlot, PartialSums};
use super::{
    LossSpec, LossTerm, Term, TermInputs, TermOn, ViewSource, check_weight, no_scratch, pixel_count,
};
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{
    DepthGradient, DepthMoments, depth_boxes, depth_correlation, depth_gradient, depth_moments,
};
use crate::{Error, Result};

pub(super) const SPEC: LossSpec = LossSpec {
    terms: &[Term::DEPTH, Term::DEPTH_LOCAL],
    on: TermOn::Feature(Feature::Depth, |gpu, config| {
        let weight = config.weights.depth;
        Ok(Box::new(DepthLoss::new(gpu, weight, config.depth_box, config.boxes)?))
    }),
};

impl Term {
    /// 1 - correlation of depths over the view.
    pub const DEPTH: Self = Self::distance("depth", "depth", |config| config.weights.depth);
    /// Mean 1 - correlation of depths over boxes.
    pub const DEPTH_LOCAL: Self =
        Self { column: "depth_local", name: "local depth", ..Self::DEPTH };
}

/// The boxes of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DepthBoxes {
    /// The side of a box in pixels.
    pub side: u32,
    /// Their number: half as many as fit side by side, at least one; 0 in a view below 4 x 4.
    pub count: u32,
}

impl DepthBoxes {
    /// Boxes of side `box_side`, at most half the shorter side of a view of `size`.
    pub fn new(size: UVec2, box_side: u32) -> Self {
        let shorter = size.min_element();
        let side = if shorter >= box_side { box_side } else { shorter / 2 };
        if side < 2 {
            return Self { side: 0, count: 0 };
        }
        let fit = (size / side).element_product();
        Self { side, count: (fit / 2).max(1) }
    }
}

/// weight * (P over the view + mean of P over boxes).
#[derive(Debug)]
pub struct DepthLoss {
    gpu: Gpu,
    weight: f64,
    box_side: u32,
    /// Draws the positions of the boxes; the draw is that of the step.
    stream: Stream,
    chunk_size: u32,
    boxes: Pipeline<depth_boxes::Kernel>,
    moments: Pipeline<depth_moments::Kernel>,
    correlation: Pipeline<depth_correlation::Kernel>,
    gradient: Pipeline<depth_gradient::Kernel>,
    regions: Buffer<[u32; 4]>,
    chunk_moments: Buffer<DepthMoments>,
    gradients: Buffer<DepthGradient>,
    view_value: Buffer<f32>,
    box_values: Buffer<f32>,
    /// The estimated depth of every view that has one, (H, W) each.
    depths: Vec<Option<Arc<Buffer<f32>>>>,
}

/// How the regions of a view are split into chunks.
#[derive(Clone, Copy)]
struct DepthChunks {
    boxes: DepthBoxes,
    of_view: u32,
    of_box: u32,
}

impl DepthChunks {
    fn total(self) -> u32 {
        self.of_view.saturating_add(self.boxes.count.saturating_mul(self.of_box))
    }
}

impl DepthLoss {
    /// Builds the kernels; [`DepthLoss::reserve`] allocates. A box has a side of `box_side` pixels where the view is
    /// large enough for it, at a position drawn from `stream`.
    pub fn new(gpu: &Gpu, weight: f64, box_side: u32, stream: Stream) -> Result<Self> {
        check_weight("the depth", weight)?;
        if !(2..=4096).contains(&box_side) {
            return Err(Error::Usage(format!(
                "the side of the depth boxes is {box_side}; it must be within 2 and 4096"
            )));
        }
        let constants = depth_moments::Constants::default();
        Ok(Self {
            gpu: gpu.clone(),
            weight,
            box_side,
            stream,
            chunk_size: gpu.properties().subgroup_size * constants.values_per_thread,
            boxes: gpu.pipeline(&depth_boxes::Constants {})?,
            moments: gpu.pipeline(&constants)?,
            correlation: gpu.pipeline(&depth_correlation::Constants::default())?,
            gradient: gpu.pipeline(&depth_gradient::Constants {})?,
            regions: gpu.uninit("depth_regions", 0)?,
            chunk_moments: gpu.uninit("depth_moments", 0)?,
            gradients: gpu.uninit("depth_gradients", 0)?,
            view_value: gpu.uninit("depth_view_value", 1)?,
            box_values: gpu.uninit("depth_box_values", 0)?,
            depths: vec![],
        })
    }

    /// Adds a view by its estimated depth, (H, W), larger is farther.
    pub fn add(&mut self, depth: Option<&[f32]>) -> Result<()> {
        let depth = depth.map(|depth| self.gpu.buffer("depth", depth).map(Arc::new));
        self.depths.push(depth.transpose()?);
        Ok(())
    }

    /// Allocates scratch memory for views up to `size`; it never shrinks.
    pub fn reserve(&mut self, size: UVec2) -> Result<()> {
        let chunks = self.chunks(size);
        let boxes = chunks.boxes.count as usize;
        self.box_values.grow(&self.gpu, boxes)?;
        self.gradients.grow(&self.gpu, boxes + 1)?;
        self.regions.grow(&self.gpu, boxes + 1)?;
        self.chunk_moments.grow(&self.gpu, chunks.total() as usize)
    }

    /// P of every region and its gradient, from the moments of its chunks.
    fn correlate(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: &TermInputs<'_>,
        depth: &Buffer<f32>,
        chunks: DepthChunks,
    ) -> Result<()> {
        let &TermInputs { size, render, .. } = inputs;
        let (width, first) = (size.x, inputs.plane(Feature::Depth) * pixel_count(size));
        let (view_chunks, box_chunks) = (chunks.of_view, chunks.of_box);
        pass.dispatch(
            &self.moments,
            &depth_moments::Params {
                width,
                first,
                view_chunks,
                box_chunks,
                chunk_count: chunks.total(),
                chunk_size: self.chunk_size,
            },
            depth_moments::Buffers {
                render: render.slice(),
                depth: depth.slice(),
                regions: self.regions.slice(),
                moments: self.chunk_moments.slice_mut(),
            },
            Threads::Workgroups([chunks.total(), 1, 1]),
        )?;
        let (weight, boxes) = (self.weight, chunks.boxes.count);
        pass.dispatch(
            &self.correlation,
            &depth_correlation::Params {
                width,
                first,
                view_chunks,
                box_chunks,
                region_count: boxes + 1,
                chunk_size: self.chunk_size,
                view_weight: weight as f32,
                box_weight: (weight / f64::from(boxes.max(1))) as f32,
            },
            depth_correlation::Buffers {
                render: render.slice(),
                depth: depth.slice(),
                regions: self.regions.slice(),
                moments: self.chunk_moments.slice(),
                gradients: self.gradients.slice_mut(),
                view_values: self.view_value.slice_mut(),
                box_values: self.box_values.slice_mut(),
            },
            Threads::Workgroups([boxes + 1, 1, 1]),
        )
    }

    fn chunks(&self, size: UVec2) -> DepthChunks {
        let boxes = DepthBoxes::new(size, self.box_side);
        DepthChunks {
            boxes,
            of_view: pixel_count(size).div_ceil(self.chunk_size),
            of_box: (boxes.side * boxes.side).div_ceil(self.chunk_size),
        }
    }
}

impl LossTerm for DepthLoss {
    fn prepare(&mut self, views: &[ViewSource<'_>]) -> Result<()> {
        for view in views {
            self.reserve(view.size)?;
            self.add(view.depth)?;
        }
        Ok(())
    }

    /// Writes the plane of `d_render` and both values; without boxes, that of the view only.
    fn record_step(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: &TermInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let &TermInputs { size, render, view, step, .. } = inputs;
        let Some(Some(depth)) = self.depths.get(view).cloned() else { return Ok(()) };
        let plane = inputs.plane(Feature::Depth);
        let (pixels, chunks) = (pixel_count(size), self.chunks(size));
        let region_count = chunks.boxes.count + 1;
        let fits = region_count as usize <= self.regions.len()
            && chunks.total() as usize <= self.chunk_moments.len();
        if pixels == 0 || !fits {
            return Err(no_scratch("depth term", size));
        }
        depth.check_len(pixels as usize)?;
        for buffer in [render, &*d_render] {
            buffer.check_len((plane as usize + 1) * pixels as usize)?;
        }
        log.check()?;
        pass.dispatch(
            &self.boxes,
            &depth_boxes::Params {
                size,
                side: chunks.boxes.side,
                box_count: chunks.boxes.count,
                key: (self.stream.bits(step) >> 32) as u32,
            },
            depth_boxes::Buffers { regions: self.regions.slice_mut() },
            Threads::Exactly([region_count, 1, 1]),
        )?;
        self.correlate(pass, inputs, &depth, chunks)?;
        pass.dispatch(
            &self.gradient,
            &depth_gradient::Params { size, first: plane * pixels, region_count },
            depth_gradient::Buffers {
                render: render.slice(),
                depth: depth.slice(),
                regions: self.regions.slice(),
                gradients: self.gradients.slice(),
                d_render: d_render.slice_mut(),
            },
            Threads::Exactly([pixels, 1, 1]),
        )?;
        let boxes = chunks.boxes.count;
        let sums = |term, partials, count: u32| {
            let scale = 1.0 / count.max(1) as f32;
            PartialSums { term, partials, count, scale }
        };
        log.record(
            pass,
            [
                sums(Term::DEPTH, &self.view_value, 1),
                sums(Term::DEPTH_LOCAL, &self.box_values, boxes),
            ],
        )
    }
}
