//! The denoising terms: the denoised image must be close to the target (in the paper's variant, to the render), and
//! smooth.

use glam::UVec2;

use super::log::{LogSlot, PartialSums};
use super::{LossRegion, LossSpec, Term, TermOn, check_weight, holds, no_scratch, value_count};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::denoising;

pub(super) const SPEC: LossSpec =
    LossSpec { terms: &[Term::DENOISING, Term::TOTAL_VARIATION], on: TermOn::Networks };

impl Term {
    /// Mean squared difference between the denoised image and its target.
    pub const DENOISING: Self = Self {
        column: "denoising",
        name: "denoising",
        is_likeness: false,
        weight: |config| config.weights.denoising,
    };
    /// Total variation of the denoised image.
    pub const TOTAL_VARIATION: Self = Self {
        column: "total_variation",
        name: "total variation",
        weight: |config| config.weights.total_variation,
        ..Self::DENOISING
    };
}

/// The weights of the terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DenoisingWeights {
    /// Of the mean squared difference between the denoised image and its target.
    pub mse: f64,
    /// Of the total variation of the denoised image.
    pub total_variation: f64,
}

/// The inputs of one step.
#[derive(Clone, Copy, Debug)]
pub struct DenoisingInputs<'a> {
    /// Width and height in pixels.
    pub size: UVec2,
    /// The pixels that count.
    pub loss_region: LossRegion,
    /// (3, H, W)
    pub denoised: &'a Buffer<f32>,
    /// Its target, (3, H, W).
    pub render: &'a Buffer<f32>,
}

/// The outputs, (3, H, W) each; both gradients are written, not added to.
#[derive(Debug)]
pub struct DenoisingGradients<'a> {
    /// With respect to the denoised image.
    pub d_denoised: &'a mut Buffer<f32>,
    /// With respect to the render.
    pub d_render: &'a mut Buffer<f32>,
}

/// mse * mean (denoised - render)^2 + `total_variation` * TV(denoised).
#[derive(Debug)]
pub struct DenoisingLoss {
    gpu: Gpu,
    weights: DenoisingWeights,
    pipeline: Pipeline<denoising::Kernel>,
    subgroup_size: u32,
    rows: u32,
    mse_partials: Buffer<f32>,
    tv_partials: Buffer<f32>,
}

impl DenoisingLoss {
    /// Builds the kernel; [`DenoisingLoss::reserve`] allocates.
    pub fn new(gpu: &Gpu, weights: DenoisingWeights) -> Result<Self> {
        check_weight("the denoising", weights.mse)?;
        check_weight("the total variation", weights.total_variation)?;
        let constants = denoising::Constants::default();
        Ok(Self {
            gpu: gpu.clone(),
            weights,
            pipeline: gpu.pipeline(&constants)?,
            subgroup_size: gpu.properties().subgroup_size,
            rows: constants.rows,
            mse_partials: gpu.uninit("mse_partials", 0)?,
            tv_partials: gpu.uninit("tv_partials", 0)?,
        })
    }

    /// Whether a weight is above 0.
    pub fn is_on(&self) -> bool {
        self.weights.mse > 0.0 || self.weights.total_variation > 0.0
    }

    /// Allocates scratch memory for views up to `size`; it never shrinks.
    pub fn reserve(&mut self, size: UVec2) -> Result<()> {
        let workgroups = self.workgroups(size) as usize;
        if workgroups > self.mse_partials.len() {
            self.mse_partials = self.gpu.uninit("mse_partials", workgroups)?;
            self.tv_partials = self.gpu.uninit("tv_partials", workgroups)?;
        }
        Ok(())
    }

    /// Writes both gradients for the whole view, 0 outside the loss region, and both terms to the log.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        DenoisingInputs { size, loss_region, denoised, render }: DenoisingInputs<'_>,
        DenoisingGradients { d_denoised, d_render }: DenoisingGradients<'_>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let workgroups = self.workgroups(size);
        if size.min_element() == 0 || workgroups as usize > self.mse_partials.len() {
            return Err(no_scratch("denoising term", size));
        }
        loss_region.check(size)?;
        for buffer in [denoised, render, &*d_denoised, &*d_render] {
            holds(buffer, value_count(size) as usize)?;
        }
        log.check()?;
        let UVec2 { x: columns, y: rows } = loss_region.size;
        // A single column or row has no pairs of neighbours.
        let pair_scale = |pairs: u32| if pairs == 0 { 0.0 } else { 2.0 / (3.0 * pairs as f32) };
        let mean_scale = 1.0 / value_count(loss_region.size) as f32;
        pass.dispatch(
            &self.pipeline,
            &denoising::Params {
                width: size.x,
                height: size.y,
                loss_begin: loss_region.origin,
                loss_end: loss_region.end(),
                mse_weight: self.weights.mse as f32,
                tv_weight: self.weights.total_variation as f32,
                mean_scale,
                x_scale: pair_scale((columns - 1) * rows),
                y_scale: pair_scale(columns * (rows - 1)),
            },
            denoising::Buffers {
                denoised: denoised.slice(),
                render: render.slice(),
                d_denoised: d_denoised.slice_mut(),
                d_render: d_render.slice_mut(),
                mse_partials: self.mse_partials.slice_mut(),
                tv_partials: self.tv_partials.slice_mut(),
            },
            Threads::Workgroups([workgroups, 1, 1]),
        )?;
        let sums = |term, partials, scale| PartialSums { term, partials, count: workgroups, scale };
        log.record(
            pass,
            [
                sums(Term::DENOISING, &self.mse_partials, mean_scale),
                sums(Term::TOTAL_VARIATION, &self.tv_partials, 1.0),
            ],
        )
    }

    /// One subgroup per workgroup; one workgroup per partial sum.
    fn workgroups(&self, size: UVec2) -> u32 {
        value_count(UVec2::new(size.x, size.y.div_ceil(self.rows))).div_ceil(self.subgroup_size)
    }
}
