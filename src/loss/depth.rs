//! The depth term: a plane of the render correlates with an estimated depth, over the view and over random boxes.
//!
//! P(a, b) = 1 - mean(a^ b^), a^ = (a - mean a) / (s + 1e-6), s^2 the unbiased variance of a: the estimate's scale
//! and offset do not matter.

use glam::UVec2;

use super::log::{LogSlot, PartialSums};
use super::{
    LossSpec, LossTerm, Term, TermInputs, TermOn, ViewSource, check_weight, holds, no_scratch,
    pixel_count,
};
use crate::base::random::Stream;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{
    DepthGradient, DepthMoments, depth_boxes, depth_correlation, depth_gradient, depth_moments,
};
use crate::splats::scene::Feature;
use crate::{Error, Result};

pub(super) const SPEC: LossSpec = LossSpec {
    terms: &[Term::DEPTH, Term::DEPTH_LOCAL],
    on: TermOn::Feature(Feature::Depth, |gpu, config| {
        let settings = DepthSettings { weight: config.weights.depth, box_side: config.depth_box };
        let loss = DepthLoss::new(gpu, settings)?;
        Ok(Box::new(DepthTerm { loss, boxes: config.boxes, depths: vec![] }))
    }),
};

impl Term {
    /// 1 - correlation of depths over the view.
    pub const DEPTH: Self = Self {
        column: "depth",
        name: "depth",
        is_likeness: false,
        weight: |config| config.weights.depth,
    };
    /// Mean 1 - correlation of depths over boxes.
    pub const DEPTH_LOCAL: Self =
        Self { column: "depth_local", name: "local depth", ..Self::DEPTH };
}

/// Builds the term with the depth of every view that has one, (H, W) each.
#[derive(Debug)]
struct DepthTerm {
    loss: DepthLoss,
    boxes: Stream,
    depths: Vec<Option<Buffer<f32>>>,
}

impl LossTerm for DepthTerm {
    fn prepare(&mut self, views: &[ViewSource<'_>]) -> Result<()> {
        let gpu = self.loss.gpu.clone();
        for view in views {
            self.loss.reserve(view.size)?;
            let depth = view.depth.map(|depth| gpu.buffer("depth", depth));
            self.depths.push(depth.transpose()?);
        }
        Ok(())
    }

    fn record_step(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: &TermInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let &TermInputs { size, render, view, step, .. } = inputs;
        let Some(Some(depth)) = self.depths.get(view) else { return Ok(()) };
        let plane = inputs.plane(Feature::Depth);
        let inputs = DepthInputs { size, render, plane, depth, stream: self.boxes, step };
        self.loss.record(pass, inputs, d_render, log)
    }
}

/// The weight of the depth term, and its boxes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthSettings {
    /// The weight of P over the view, and of the mean of P over the boxes.
    pub weight: f64,
    /// The side of a box in pixels, where the view is large enough for it.
    pub box_side: u32,
}

impl Default for DepthSettings {
    /// As LITA-GS: weight 0.1, boxes of 128 x 128.
    fn default() -> Self {
        Self { weight: 0.1, box_side: 128 }
    }
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

/// The inputs of one step.
#[derive(Clone, Copy, Debug)]
pub struct DepthInputs<'a> {
    /// Width and height in pixels.
    pub size: UVec2,
    /// (channels, H, W)
    pub render: &'a Buffer<f32>,
    /// The depth channel.
    pub plane: u32,
    /// (H, W), larger is farther.
    pub depth: &'a Buffer<f32>,
    /// The random numbers that place the boxes.
    pub stream: Stream,
    /// The draw of the stream; the same draw gives the same boxes.
    pub step: u64,
}

/// weight * (P over the view + mean of P over boxes).
#[derive(Debug)]
pub struct DepthLoss {
    gpu: Gpu,
    settings: DepthSettings,
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
}

/// How the regions of a view are split into chunks.
#[derive(Clone, Copy)]
struct Chunks {
    boxes: DepthBoxes,
    of_view: u32,
    of_box: u32,
}

impl Chunks {
    fn total(self) -> u32 {
        self.of_view.saturating_add(self.boxes.count.saturating_mul(self.of_box))
    }
}

impl DepthLoss {
    /// Builds the kernels; [`DepthLoss::reserve`] allocates.
    pub fn new(gpu: &Gpu, settings: DepthSettings) -> Result<Self> {
        check_weight("the depth", settings.weight)?;
        if !(2..=4096).contains(&settings.box_side) {
            return Err(Error::Usage(format!(
                "the side of the depth boxes is {}; it must be within 2 and 4096",
                settings.box_side
            )));
        }
        let constants = depth_moments::Constants::default();
        Ok(Self {
            gpu: gpu.clone(),
            settings,
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
        })
    }

    /// The boxes of a view of `size`.
    pub fn boxes(&self, size: UVec2) -> DepthBoxes {
        DepthBoxes::new(size, self.settings.box_side)
    }

    /// Allocates scratch memory for views up to `size`; it never shrinks.
    pub fn reserve(&mut self, size: UVec2) -> Result<()> {
        let chunks = self.chunks(size);
        let regions = chunks.boxes.count as usize + 1;
        if regions > self.regions.len() {
            self.box_values = self.gpu.uninit("depth_box_values", regions - 1)?;
            self.gradients = self.gpu.uninit("depth_gradients", regions)?;
            self.regions = self.gpu.uninit("depth_regions", regions)?;
        }
        if chunks.total() as usize > self.chunk_moments.len() {
            self.chunk_moments = self.gpu.uninit("depth_moments", chunks.total() as usize)?;
        }
        Ok(())
    }

    /// Writes the plane of `d_render`, (channels, H, W), and both values to the log; without boxes, the global one
    /// only.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: DepthInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let DepthInputs { size, render, plane, depth, stream, step } = inputs;
        let (pixels, chunks) = (pixel_count(size), self.chunks(size));
        let region_count = chunks.boxes.count + 1;
        let fits = region_count as usize <= self.regions.len()
            && chunks.total() as usize <= self.chunk_moments.len();
        if pixels == 0 || !fits {
            return Err(no_scratch("depth term", size));
        }
        holds(depth, pixels as usize)?;
        for buffer in [render, &*d_render] {
            holds(buffer, (plane as usize + 1) * pixels as usize)?;
        }
        log.check()?;
        pass.dispatch(
            &self.boxes,
            &depth_boxes::Params {
                size,
                side: chunks.boxes.side,
                box_count: chunks.boxes.count,
                key: (stream.bits(step) >> 32) as u32,
            },
            depth_boxes::Buffers { regions: self.regions.slice_mut() },
            Threads::Exactly([region_count, 1, 1]),
        )?;
        self.correlate(pass, inputs, chunks)?;
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

    /// P of every region and its gradient, from the moments of its chunks.
    fn correlate(
        &mut self,
        pass: &mut Recorder<'_>,
        DepthInputs { size, render, plane, depth, .. }: DepthInputs<'_>,
        chunks: Chunks,
    ) -> Result<()> {
        let (width, first) = (size.x, plane * pixel_count(size));
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
        let (weight, boxes) = (self.settings.weight, chunks.boxes.count);
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

    fn chunks(&self, size: UVec2) -> Chunks {
        let boxes = self.boxes(size);
        Chunks {
            boxes,
            of_view: pixel_count(size).div_ceil(self.chunk_size),
            of_box: (boxes.side * boxes.side).div_ceil(self.chunk_size),
        }
    }
}
