//! The log of the loss terms: one row per step, one column per term, filled on the device.

use super::Term;
use crate::gpu::{Buffer, Download, Gpu, Pipeline, Recorder, SliceMut, Threads};
use crate::kernels::loss_log;
use crate::kernels::status::STATUS_WORDS;
use crate::{Error, Result};

/// The terms of one step.
#[derive(Clone, Debug, PartialEq)]
pub struct StepLosses {
    /// The status word after the last term: the step counts only if it is 0.
    pub status: u32,
    /// One per term.
    values: Vec<f32>,
}

impl StepLosses {
    /// The mean of `term`; 0 if it was never recorded.
    pub fn get(&self, term: Term) -> f32 {
        self.values[term.index()]
    }

    /// The first term that is NaN or infinite.
    pub fn first_not_finite(&self) -> Option<Term> {
        Term::all().find(|&term| !self.get(term).is_finite())
    }
}

/// The terms of one step per slot, on the device.
#[derive(Debug)]
pub struct LossLog {
    pipeline: Pipeline<loss_log::Kernel>,
    /// (slots, terms)
    values: Buffer<f32>,
    /// (slots,)
    statuses: Buffer<u32>,
}

/// A download of a log.
#[derive(Debug)]
pub struct LossLogDownload {
    values: Download<f32>,
    statuses: Download<u32>,
}

/// The row of the log for one step.
#[derive(Debug)]
pub struct LogSlot<'a> {
    /// The log.
    pub log: &'a mut LossLog,
    /// The row that this step fills.
    pub slot: u32,
    /// The status words; the first gets the bit `STATUS_NOT_FINITE` if a term is NaN or infinite.
    pub status: &'a mut Buffer<u32>,
}

/// The row of a step, for a kernel that writes it.
#[derive(Debug)]
pub(super) struct LogRow<'a> {
    pub(super) slot: u32,
    pub(super) term_count: u32,
    pub(super) log: SliceMut<'a, f32>,
    pub(super) statuses: SliceMut<'a, u32>,
    pub(super) status: SliceMut<'a, u32>,
}

/// A term and the partial sums whose scaled sum it is; without any, its column is unchanged.
#[derive(Clone, Copy)]
pub(super) struct PartialSums<'a> {
    pub(super) term: Term,
    pub(super) partials: &'a Buffer<f32>,
    pub(super) count: u32,
    pub(super) scale: f32,
}

impl LossLog {
    /// A log of zeros.
    pub fn new(gpu: &Gpu, slots: usize) -> Result<Self> {
        Ok(Self {
            pipeline: gpu.pipeline(&loss_log::Constants::default())?,
            values: gpu.zeros("loss_log", slots * Term::all().count())?,
            statuses: gpu.zeros("step_statuses", slots)?,
        })
    }

    /// Records zeros: a term that a step omits is 0.
    pub fn clear(&mut self, pass: &mut Recorder<'_>) {
        pass.fill(&mut self.values, 0);
    }

    /// Copies the log at this point of the recording to the host.
    pub fn download(&self, pass: &mut Recorder<'_>) -> Result<LossLogDownload> {
        Ok(LossLogDownload {
            values: pass.download(&self.values)?,
            statuses: pass.download(&self.statuses)?,
        })
    }
}

impl LossLogDownload {
    /// Waits for the submission of the copy; returns one element per slot.
    pub fn wait(self) -> Result<Vec<StepLosses>> {
        let (values, statuses) = (self.values.wait()?, self.statuses.wait()?);
        let rows = values.chunks_exact(Term::all().count()).map(<[f32]>::to_vec).zip(statuses);
        Ok(rows.map(|(values, status)| StepLosses { status, values }).collect())
    }
}

impl LogSlot<'_> {
    /// Checks that the log has the slot, before anything is recorded.
    pub(super) fn check(&self) -> Result<()> {
        let (slot, slots) = (self.slot, self.log.statuses.len());
        if slot as usize >= slots || self.status.len() < STATUS_WORDS as usize {
            return Err(Error::Usage(format!(
                "the loss log has no slot {slot} of {slots}, or there are no status words"
            )));
        }
        Ok(())
    }

    /// What a kernel binds that writes the row itself: slot, columns, the log, the statuses and the status words.
    pub(super) fn row(&mut self) -> LogRow<'_> {
        LogRow {
            slot: self.slot,
            term_count: Term::all().count() as u32,
            log: self.log.values.slice_mut(),
            statuses: self.log.statuses.slice_mut(),
            status: self.status.slice_mut(),
        }
    }

    /// The means of two terms.
    pub(super) fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        [first, second]: [PartialSums<'_>; 2],
    ) -> Result<()> {
        pass.dispatch(
            &self.log.pipeline,
            &loss_log::Params {
                slot: self.slot,
                term_count: Term::all().count() as u32,
                terms: [first.term.index() as u32, second.term.index() as u32].into(),
                partial_counts: [first.count, second.count].into(),
                mean_scales: [first.scale, second.scale].into(),
            },
            loss_log::Buffers {
                first_partials: first.partials.slice(),
                second_partials: second.partials.slice(),
                log: self.log.values.slice_mut(),
                statuses: self.log.statuses.slice_mut(),
                status: self.status.slice_mut(),
            },
            Threads::Workgroups([1, 1, 1]),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::{LossConfig, ParameterWeights, Weights};
    use nightsplat_core::random::Stream;
    use nightsplat_models::gaussians::Features;

    #[test]
    fn the_total_sums_distances_and_one_minus_similarities() {
        let config = LossConfig {
            ssim_weight: 0.25,
            weights: Weights {
                denoising: 0.0,
                structure: 0.0,
                depth: 0.0,
                normals: 0.0,
                ..Weights::default()
            },
            low: 0.0,
            parameters: ParameterWeights::default(),
            depth_box: 1,
            boxes: Stream::new(0, 0),
            features: Features::NONE,
            steps: 1,
        };
        let value = |term: Term| if term.is_likeness { 0.75 } else { 0.5 };
        let losses = StepLosses { status: 0, values: Term::all().map(value).collect() };
        assert_eq!(config.total(&losses), 0.75 * 0.5 + 0.25 * (1.0 - 0.75));
    }
}
