//! The loss between a render and an image: L = (1 - w) mean|a - b| + w (1 - mean SSIM), means over all values of the
//! loss region.
//!
//! `a` is the render, not clamped, and `b` the image. SSIM is that of 3DGS: an 11 x 11 Gaussian window with sigma 1.5,
//! per channel, zero padding. R_0 is compared with the target, and the tonemapper's output with the dark photograph.

mod ssim;

use std::num::NonZeroU32;

use glam::UVec2;

use ssim::SsimLoss;

use super::log::{LogSlot, PartialSums};
use super::{
    Gradient, LossRegion, LossSpec, LossTerm, Term, TermInputs, TermOn, ViewSource, no_scratch,
    value_count,
};
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::l1;
use crate::{Error, Result};

/// R_0 and the target.
pub(super) const TARGET: LossSpec = LossSpec {
    terms: &[Term::L1, Term::SSIM],
    on: TermOn::Colors(|gpu, config, gradient| {
        let terms = [Term::L1, Term::SSIM];
        Ok(Box::new(Loss::new(gpu, config.ssim_weight, terms, gradient)?))
    }),
};

/// The dark reconstruction and the photograph.
pub(super) const DARK: LossSpec =
    LossSpec { terms: &[Term::LOW_L1, Term::LOW_SSIM], on: TermOn::Networks };

impl Term {
    /// Mean |render - target|.
    pub const L1: Self = Self::distance("l1", "L1", |config| 1.0 - config.ssim_weight);
    /// Mean SSIM of render and target.
    pub const SSIM: Self = Self::likeness("ssim", "SSIM", |config| config.ssim_weight);
    /// Mean |render - photograph| of the dark reconstruction.
    pub const LOW_L1: Self = Self::distance("low_l1", "L1 of the dark reconstruction", |config| {
        config.low * (1.0 - config.weights.low_ssim)
    });
    /// Mean SSIM of the dark reconstruction and the photograph.
    pub const LOW_SSIM: Self =
        Self::likeness("low_ssim", "SSIM of the dark reconstruction", |config| {
            config.low * config.weights.low_ssim
        });
}

/// An image and the image that it is compared with.
#[derive(Clone, Copy, Debug)]
pub struct LossInputs<'a> {
    /// Width and height in pixels.
    pub size: UVec2,
    /// The pixels that count.
    pub loss_region: LossRegion,
    /// (3, H, W), not clamped.
    pub render: &'a Buffer<f32>,
    /// (3, H, W)
    pub target: &'a Buffer<f32>,
}

/// The kernels of L1 and SSIM and their scratch memory.
#[derive(Debug)]
pub struct Loss {
    gpu: Gpu,
    terms: [Term; 2],
    kernels: ImageKernels,
    max_values: u32,
    l1_partials: Buffer<f32>,
    ssim_partials: Buffer<f32>,
}

#[derive(Debug)]
enum ImageKernels {
    /// The SSIM weight is zero: SSIM is not evaluated.
    L1 {
        whole: Pipeline<l1::Kernel>,
        loss_region: Pipeline<l1::Kernel>,
        values_per_workgroup: u32,
    },
    Ssim(SsimLoss),
}

impl Loss {
    /// Builds the kernels; [`Loss::reserve`] allocates. `ssim_weight` is w; `terms` are the columns of mean|a - b| and
    /// of mean SSIM.
    pub fn new(gpu: &Gpu, ssim_weight: f64, terms: [Term; 2], gradient: Gradient) -> Result<Self> {
        let adds = gradient == Gradient::Added;
        if !(0.0..=1.0).contains(&ssim_weight) {
            return Err(Error::Usage(format!(
                "the SSIM weight is {ssim_weight}; it must be within 0 and 1"
            )));
        }
        let subgroup_size = gpu.properties().subgroup_size;
        let kernels = if ssim_weight > 0.0 {
            ImageKernels::Ssim(SsimLoss::new(gpu, ssim_weight, adds)?)
        } else {
            let constants = l1::Constants { adds, ..Default::default() };
            ImageKernels::L1 {
                whole: gpu.pipeline(&constants)?,
                loss_region: gpu
                    .pipeline(&l1::Constants { with_loss_region: true, ..constants })?,
                values_per_workgroup: subgroup_size * constants.values_per_thread,
            }
        };
        Ok(Self {
            gpu: gpu.clone(),
            terms,
            kernels,
            max_values: 0,
            l1_partials: gpu.uninit("l1_partials", 0)?,
            ssim_partials: gpu.uninit("ssim_partials", 0)?,
        })
    }

    /// Divides views into about this number of strips for SSIM, where the device is a GPU. Gradients do not depend on
    /// it, the last bits of the logged means do.
    #[doc(hidden)]
    pub fn set_ssim_strips(&mut self, count: NonZeroU32) {
        if let ImageKernels::Ssim(ssim) = &mut self.kernels {
            ssim.set_strips(count);
        }
    }

    /// Allocates scratch memory for views up to `size`; it never shrinks.
    pub fn reserve(&mut self, size: UVec2) -> Result<()> {
        self.max_values = self.max_values.max(value_count(size));
        let workgroups = self.kernels.most_workgroups(size) as usize;
        self.l1_partials.grow(&self.gpu, workgroups)?;
        self.ssim_partials.grow(&self.gpu, workgroups)?;
        match &mut self.kernels {
            ImageKernels::Ssim(ssim) => ssim.reserve(&self.gpu, size, self.max_values),
            ImageKernels::L1 { .. } => Ok(()),
        }
    }

    /// Writes dL/d render, (3, H, W), to `d_render` or adds it, also outside the loss region, and writes the means of
    /// |a - b| and of SSIM to the log. If the SSIM weight is 0, SSIM is neither evaluated nor logged.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: LossInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        self.check(&inputs, d_render, log)?;
        let workgroups = self.kernels.workgroups(inputs.size);
        let [l1_partials, ssim_partials] = [&mut self.l1_partials, &mut self.ssim_partials];
        let mut ssim_count = 0;
        match &mut self.kernels {
            ImageKernels::L1 { whole, loss_region, .. } => {
                let LossInputs { size, render, target, .. } = inputs;
                let is_whole = inputs.loss_region == LossRegion::whole(size);
                pass.dispatch(
                    if is_whole { whole } else { loss_region },
                    &l1::Params {
                        value_count: value_count(size),
                        l1_scale: 1.0 / inputs.loss_region.value_count() as f32,
                        width: size.x,
                        height: size.y,
                        loss_begin: inputs.loss_region.origin,
                        loss_end: inputs.loss_region.end(),
                    },
                    l1::Buffers {
                        render: render.slice(),
                        target: target.slice(),
                        d_render: d_render.slice_mut(),
                        partials: l1_partials.slice_mut(),
                    },
                    Threads::Workgroups([workgroups, 1, 1]),
                )?;
            }
            ImageKernels::Ssim(ssim) => {
                ssim_count = workgroups;
                let partials = [l1_partials, ssim_partials];
                if ssim.record(pass, inputs, d_render, partials, self.terms, log)? {
                    return Ok(());
                }
            }
        }
        let scale = 1.0 / inputs.loss_region.value_count() as f32;
        let [l1, ssim] = self.terms;
        log.record(
            pass,
            [
                PartialSums { term: l1, partials: &self.l1_partials, count: workgroups, scale },
                PartialSums { term: ssim, partials: &self.ssim_partials, count: ssim_count, scale },
            ],
        )
    }

    /// A kernel that exceeds a buffer corrupts other data, so lengths are checked before anything is recorded.
    fn check(
        &self,
        inputs: &LossInputs<'_>,
        d_render: &Buffer<f32>,
        log: &LogSlot<'_>,
    ) -> Result<()> {
        let values = value_count(inputs.size);
        let fits = (1..=self.max_values).contains(&values)
            && self.kernels.workgroups(inputs.size) as usize <= self.l1_partials.len();
        if !fits {
            return Err(no_scratch("loss", inputs.size));
        }
        inputs.loss_region.check(inputs.size)?;
        for buffer in [inputs.render, inputs.target, d_render] {
            buffer.check_len(values as usize)?;
        }
        log.check()
    }
}

impl ImageKernels {
    /// One subgroup per workgroup; one workgroup per partial sum.
    fn workgroups(&self, size: UVec2) -> u32 {
        match self {
            Self::L1 { values_per_workgroup, .. } => {
                value_count(size).div_ceil(*values_per_workgroup)
            }
            Self::Ssim(ssim) => ssim.workgroups(size),
        }
    }

    /// At least as many as any view up to `size` has.
    fn most_workgroups(&self, size: UVec2) -> u32 {
        match self {
            Self::L1 { .. } => self.workgroups(size),
            Self::Ssim(ssim) => ssim.most_workgroups(size),
        }
    }
}

impl LossTerm for Loss {
    fn compile(&mut self) -> Result<()> {
        match &mut self.kernels {
            ImageKernels::Ssim(ssim) => ssim.compile(),
            ImageKernels::L1 { .. } => Ok(()),
        }
    }

    fn prepare(&mut self, views: &[ViewSource<'_>]) -> Result<()> {
        views.iter().try_for_each(|view| self.reserve(view.size))
    }

    fn record_step(
        &mut self,
        pass: &mut Recorder<'_>,
        &TermInputs { size, colors: render, target, .. }: &TermInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let inputs = LossInputs { size, loss_region: LossRegion::whole(size), render, target };
        self.record(pass, inputs, d_render, log)
    }
}
