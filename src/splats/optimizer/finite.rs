//! Detection of non-finite parameters.

use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Slice, Threads};
use crate::kernels::first_not_finite;

/// Finds NaN and infinity on the device, in a small fraction of a step's time.
#[derive(Debug)]
pub struct FiniteCheck {
    pipeline: Pipeline<first_not_finite::Kernel>,
    /// The lowest index; [`NONE`] if all are finite.
    first: Buffer<u32>,
}

const NONE: u32 = u32::MAX;

impl FiniteCheck {
    /// Builds the kernel.
    pub fn new(gpu: &Gpu) -> Result<Self> {
        let pipeline = gpu.pipeline(&first_not_finite::Constants::default())?;
        Ok(Self { pipeline, first: gpu.uninit("first_not_finite", 1)? })
    }

    /// The index of the first of `count` values that is not finite.
    pub fn first<'a>(
        &mut self,
        gpu: &Gpu,
        values: impl Into<Slice<'a, f32>>,
        count: usize,
    ) -> Result<Option<usize>> {
        let values = values.into();
        values.check_len(count)?;
        gpu.run("first_not_finite", |pass| {
            pass.fill(&mut self.first, NONE);
            let params = first_not_finite::Params { value_count: count as u32 };
            let buffers = first_not_finite::Buffers { values, first: self.first.slice_mut() };
            let threads = Threads::Exactly([(count as u32).div_ceil(4), 1, 1]);
            pass.dispatch(&self.pipeline, &params, buffers, threads)
        })?;
        let first = gpu.read(&self.first)?.first().copied();
        Ok(first.filter(|&first| first != NONE).map(|first| first as usize))
    }
}
