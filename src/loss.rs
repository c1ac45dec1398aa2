//! The loss of a render against the pseudo-GT, its gradient, and its log.
//!
//! L = (1 - w) mean|a - b| + w (1 - mean SSIM), means over all 3HW values; `a` is the render, not clamped, and `b` the
//! tone curve of the dark photograph, evaluated inside the kernels. SSIM is that of 3DGS: 11 x 11 Gaussian window with
//! sigma 1.5, per channel, zero padding. Nothing is read back: each step leaves its terms in a slot of a log.

use glam::{UVec2, Vec3};

use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{ToneParameters, l1, loss_log, ssim_backward, ssim_forward};
use crate::{Error, Result};

pub use crate::kernels::StepLoss;

/// The columns and rows of a view that one thread of the SSIM kernels takes.
///
/// On a processor a load costs the most, so wide strips, which share their borders' loads, win over registers that
/// spill into the first-level cache; a GPU needs narrow ones that stay in registers.
const CPU_STRIP: [u32; 2] = [16, 64];
const GPU_STRIP: [u32; 2] = [2, 32];

/// The strip that suits the device.
pub(crate) fn strip(gpu: &Gpu) -> [u32; 2] {
    if gpu.properties().is_cpu { CPU_STRIP } else { GPU_STRIP }
}

/// What one step's loss reads.
#[derive(Clone, Copy, Debug)]
pub struct LossInputs<'a> {
    /// Width and height in pixels.
    pub size: UVec2,
    /// (3, H, W), not clamped.
    pub render: &'a Buffer<f32>,
    /// (3, H, W), sRGB-encoded.
    pub low: &'a Buffer<f32>,
    /// The curve of this view, one element.
    pub tone: &'a Buffer<ToneParameters>,
}

/// What one step's loss writes beside the gradient.
#[derive(Debug)]
pub struct LossLog<'a> {
    /// One element per slot.
    pub log: &'a mut Buffer<StepLoss>,
    /// The element that this step fills.
    pub slot: u32,
    /// The sticky status word; `not_finite_flag` is set in its first element if a term is NaN or infinite.
    pub status: &'a mut Buffer<u32>,
    /// The bits to set.
    pub not_finite_flag: u32,
}

/// The loss kernels and their scratch memory, sized for a set of views.
#[derive(Debug)]
pub struct Loss {
    terms: Terms,
    log: Pipeline<loss_log::Kernel>,
    max_values: u32,
    l1_partials: Buffer<f32>,
    ssim_partials: Buffer<f32>,
}

#[derive(Debug)]
enum Terms {
    /// The SSIM weight is zero: no SSIM is evaluated.
    L1 {
        pipeline: Pipeline<l1::Kernel>,
        values_per_workgroup: u32,
    },
    Ssim(Ssim),
}

#[derive(Debug)]
struct Ssim {
    weight: f64,
    strip: [u32; 2],
    subgroup_size: u32,
    forward: Pipeline<ssim_forward::Kernel>,
    backward: Pipeline<ssim_backward::Kernel>,
    /// (3, H, W), dS/dE\[a\], dS/dE\[aa\], dS/dE\[ab\].
    d_moments: Buffer<Vec3>,
}

impl Loss {
    /// The kernels for `tone_curve` (a `CURVE_*` of include/tone.glsl) and an SSIM weight in [0, 1], and scratch memory
    /// that holds the largest of the views' `sizes`.
    ///
    /// # Errors
    /// The weight is outside [0, 1], or the device is out of memory.
    pub fn new(gpu: &Gpu, tone_curve: u32, ssim_weight: f64, sizes: &[UVec2]) -> Result<Self> {
        if !(0.0..=1.0).contains(&ssim_weight) {
            return Err(Error::Usage(format!(
                "the SSIM weight is {ssim_weight}; it must be within 0 and 1"
            )));
        }
        let subgroup_size = gpu.properties().subgroup_size;
        let max_values = sizes.iter().map(|&size| value_count(size)).max().unwrap_or(0);
        let terms = if ssim_weight > 0.0 {
            let [columns, rows] = strip(gpu);
            Terms::Ssim(Ssim {
                weight: ssim_weight,
                strip: [columns, rows],
                subgroup_size,
                forward: gpu.pipeline(&ssim_forward::Constants { columns, rows, tone_curve })?,
                backward: gpu.pipeline(&ssim_backward::Constants { columns, rows, tone_curve })?,
                d_moments: gpu.uninit("d_moments", max_values as usize)?,
            })
        } else {
            let constants = l1::Constants { tone_curve, ..Default::default() };
            let values_per_workgroup = subgroup_size * constants.values_per_thread;
            Terms::L1 { pipeline: gpu.pipeline(&constants)?, values_per_workgroup }
        };
        let partials = sizes.iter().map(|&size| terms.workgroups(size)).max().unwrap_or(0) as usize;
        Ok(Self {
            terms,
            log: gpu.pipeline(&loss_log::Constants::default())?,
            max_values,
            l1_partials: gpu.uninit("l1_partials", partials)?,
            ssim_partials: gpu.uninit("ssim_partials", partials)?,
        })
    }

    /// Writes dL/d render, (3, H, W), to `d_render` and the means of |a - b| and of SSIM to the log. Where the SSIM
    /// weight is 0, SSIM is not evaluated and logged as 0.
    ///
    /// # Errors
    /// The view is empty or larger than those that the scratch memory is for, or a buffer is shorter than the view or the log's slot.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: LossInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: LossLog<'_>,
    ) -> Result<()> {
        self.check(&inputs, d_render, &log)?;
        let values = value_count(inputs.size);
        let workgroups = self.terms.workgroups(inputs.size);
        let threads = Threads::Workgroups([workgroups, 1, 1]);
        let [l1_partials, ssim_partials] = [&mut self.l1_partials, &mut self.ssim_partials];
        match &mut self.terms {
            Terms::L1 { pipeline, .. } => {
                let LossInputs { render, low, tone, .. } = inputs;
                pass.dispatch(
                    pipeline,
                    &l1::Params { value_count: values, l1_scale: 1.0 / values as f32 },
                    l1::Buffers { render, low, tone, d_render, partials: l1_partials },
                    threads,
                )?;
            }
            Terms::Ssim(ssim) => {
                ssim.record(pass, threads, inputs, d_render, [l1_partials, ssim_partials])?;
            }
        }
        let with_ssim = matches!(self.terms, Terms::Ssim(_));
        pass.dispatch(
            &self.log,
            &loss_log::Params {
                slot: log.slot,
                l1_partial_count: workgroups,
                ssim_partial_count: if with_ssim { workgroups } else { 0 },
                mean_scale: 1.0 / values as f32,
                not_finite_flag: log.not_finite_flag,
            },
            loss_log::Buffers {
                l1_partials: &self.l1_partials,
                ssim_partials: &self.ssim_partials,
                log: log.log,
                status: log.status,
            },
            Threads::Workgroups([1, 1, 1]),
        )
    }

    /// A kernel that runs beyond a buffer corrupts its neighbours: refuse before anything is recorded.
    fn check(
        &self,
        inputs: &LossInputs<'_>,
        d_render: &Buffer<f32>,
        log: &LossLog<'_>,
    ) -> Result<()> {
        let UVec2 { x: width, y: height } = inputs.size;
        let values = value_count(inputs.size);
        let fits = (1..=self.max_values).contains(&values)
            && self.terms.workgroups(inputs.size) as usize <= self.l1_partials.len();
        if !fits {
            return Err(Error::Usage(format!(
                "the loss has no scratch memory for a view of {width} x {height}"
            )));
        }
        for buffer in [inputs.render, inputs.low, d_render] {
            if buffer.len() < values as usize {
                let (name, len) = (buffer.name(), buffer.len());
                return Err(Error::Usage(format!(
                    "buffer `{name}` holds {len} values, the view has {values}"
                )));
            }
        }
        if log.slot as usize >= log.log.len() || inputs.tone.is_empty() || log.status.is_empty() {
            let (slot, len) = (log.slot, log.log.len());
            return Err(Error::Usage(format!(
                "the loss log has no slot {slot} of {len}, or there are no tone parameters or status word"
            )));
        }
        Ok(())
    }
}

impl Terms {
    /// One subgroup each; as many as there are partial sums.
    fn workgroups(&self, size: UVec2) -> u32 {
        match self {
            Self::L1 { values_per_workgroup, .. } => {
                value_count(size).div_ceil(*values_per_workgroup)
            }
            Self::Ssim(ssim) => {
                let [columns, rows] = ssim.strip;
                (3 * size.x.div_ceil(columns) * size.y.div_ceil(rows)).div_ceil(ssim.subgroup_size)
            }
        }
    }
}

impl Ssim {
    fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        threads: Threads<'_>,
        LossInputs { size, render, low, tone }: LossInputs<'_>,
        d_render: &mut Buffer<f32>,
        [l1_partials, ssim_partials]: [&mut Buffer<f32>; 2],
    ) -> Result<()> {
        let UVec2 { x: width, y: height } = size;
        let d_moments = &mut self.d_moments;
        pass.dispatch(
            &self.forward,
            &ssim_forward::Params { width, height },
            ssim_forward::Buffers { render, low, tone, d_moments, partials: ssim_partials },
            threads,
        )?;
        let mean_scale = 1.0 / f64::from(value_count(size));
        pass.dispatch(
            &self.backward,
            &ssim_backward::Params {
                width,
                height,
                l1_scale: ((1.0 - self.weight) * mean_scale) as f32,
                ssim_scale: (self.weight * mean_scale) as f32,
            },
            ssim_backward::Buffers {
                render,
                low,
                tone,
                d_moments,
                d_render,
                partials: l1_partials,
            },
            threads,
        )
    }
}

fn value_count(size: UVec2) -> u32 {
    size.x.saturating_mul(size.y).saturating_mul(3)
}
