//! The denoising terms: the denoised image must be close to the target (in the paper's variant, to the render), and
//! smooth.

use glam::UVec2;

use super::log::{LogSlot, PartialSums};
use super::{LossInputs, LossSpec, Term, TermOn, Weights, check_weight, no_scratch, value_count};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::denoising;

pub(super) const SPEC: LossSpec =
    LossSpec { terms: &[Term::DENOISING, Term::TOTAL_VARIATION], on: TermOn::Networks };

impl Term {
    /// Mean squared difference between the denoised image and its target.
    pub const DENOISING: Self =
        Self::distance("denoising", "denoising", |config| config.weights.denoising);
    /// Total variation of the denoised image.
    pub const TOTAL_VARIATION: Self =
        Self::distance("total_variation", "total variation", |config| {
            config.weights.total_variation
        });
}

/// `denoising` * mean (denoised - target)^2 + `total_variation` * TV(denoised), with the weights of these names.
#[derive(Debug)]
pub struct DenoisingLoss {
    gpu: Gpu,
    mse_weight: f64,
    tv_weight: f64,
    pipeline: Pipeline<denoising::Kernel>,
    subgroup_size: u32,
    rows: u32,
    mse_partials: Buffer<f32>,
    tv_partials: Buffer<f32>,
}

impl DenoisingLoss {
    /// Builds the kernel; [`DenoisingLoss::reserve`] allocates.
    pub fn new(gpu: &Gpu, weights: &Weights) -> Result<Self> {
        let Weights { denoising: mse_weight, total_variation: tv_weight, .. } = *weights;
        check_weight("the denoising", mse_weight)?;
        check_weight("the total variation", tv_weight)?;
        let constants = denoising::Constants::default();
        Ok(Self {
            gpu: gpu.clone(),
            mse_weight,
            tv_weight,
            pipeline: gpu.pipeline(&constants)?,
            subgroup_size: gpu.properties().subgroup_size,
            rows: constants.rows,
            mse_partials: gpu.uninit("mse_partials", 0)?,
            tv_partials: gpu.uninit("tv_partials", 0)?,
        })
    }

    /// Whether a weight is above 0.
    pub fn is_on(&self) -> bool {
        self.mse_weight > 0.0 || self.tv_weight > 0.0
    }

    /// Allocates scratch memory for views up to `size`; it never shrinks.
    pub fn reserve(&mut self, size: UVec2) -> Result<()> {
        let workgroups = self.workgroups(size) as usize;
        self.mse_partials.grow(&self.gpu, workgroups)?;
        self.tv_partials.grow(&self.gpu, workgroups)
    }

    /// Writes the gradients of the denoised image and of its target for the whole view, 0 outside the loss region, and
    /// both terms to the log.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        LossInputs { size, loss_region, render: denoised, target }: LossInputs<'_>,
        d_denoised: &mut Buffer<f32>,
        d_target: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let workgroups = self.workgroups(size);
        if size.min_element() == 0 || workgroups as usize > self.mse_partials.len() {
            return Err(no_scratch("denoising term", size));
        }
        loss_region.check(size)?;
        for buffer in [denoised, target, &*d_denoised, &*d_target] {
            buffer.check_len(value_count(size) as usize)?;
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
                mse_weight: self.mse_weight as f32,
                tv_weight: self.tv_weight as f32,
                mean_scale,
                x_scale: pair_scale((columns - 1) * rows),
                y_scale: pair_scale(columns * (rows - 1)),
            },
            denoising::Buffers {
                denoised: denoised.slice(),
                render: target.slice(),
                d_denoised: d_denoised.slice_mut(),
                d_render: d_target.slice_mut(),
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
