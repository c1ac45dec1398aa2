//! The exclusive scan: where each item's output begins, from how much output it has.

use super::{Count, DispatchArguments, common_len};
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{scan_downsweep, scan_spine, scan_upsweep};
use crate::{Error, Result};

/// Exclusive prefix sums of `u32` values, modulo 2^32.
#[derive(Debug)]
pub struct Scan {
    gpu: Gpu,
    upsweep: Pipeline<scan_upsweep::Kernel>,
    spine: Pipeline<scan_spine::Kernel>,
    downsweep: Pipeline<scan_downsweep::Kernel>,
    partition_size: u32,
    arguments: DispatchArguments,
    /// (partitions)
    sums: Buffer<u32>,
}

impl Scan {
    /// A scan with scratch memory for `capacity` values; longer buffers let it grow.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn new(gpu: &Gpu, capacity: u32) -> Result<Self> {
        let partition_size = scan_upsweep::Constants::default().partition_size;
        Ok(Self {
            gpu: gpu.clone(),
            upsweep: gpu.pipeline(&scan_upsweep::Constants { partition_size })?,
            spine: gpu.pipeline(&scan_spine::Constants { partition_size })?,
            downsweep: gpu.pipeline(&scan_downsweep::Constants { partition_size })?,
            partition_size,
            arguments: DispatchArguments::new(gpu)?,
            sums: gpu.uninit("scan_sums", capacity.div_ceil(partition_size) as usize)?,
        })
    }

    /// Records `offsets[i] = values[0] + .. + values[i - 1]` for each i below `count`, and `total[0]`, the sum of all
    /// values. Offsets beyond the count stay as they are; a count beyond the buffers' common length is clamped to it.
    ///
    /// # Errors
    /// The buffers' lengths differ, `total` is empty, the count's index is outside its buffer, or the device is out of
    /// memory.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        count: Count<'_>,
        values: &Buffer<u32>,
        offsets: &mut Buffer<u32>,
        total: &mut Buffer<u32>,
    ) -> Result<()> {
        let capacity = common_len("scan", &[values.len(), offsets.len()])?;
        if total.is_empty() {
            let name = total.name();
            let problem = format!("scan: buffer `{name}` is empty; give the total one element");
            return Err(Error::Usage(problem));
        }
        let partitions = capacity.div_ceil(self.partition_size) as usize;
        if self.sums.len() < partitions {
            self.sums = self.gpu.uninit("scan_sums", partitions)?;
        }
        let Count { counts, index: count_index } = count;
        self.arguments.record(pass, count, self.partition_size, capacity)?;
        pass.dispatch(
            &self.upsweep,
            &scan_upsweep::Params { count_index, capacity },
            scan_upsweep::Buffers { counts, values, sums: &mut self.sums },
            self.arguments.threads(),
        )?;
        pass.dispatch(
            &self.spine,
            &scan_spine::Params { count_index, capacity },
            scan_spine::Buffers { counts, sums: &mut self.sums, total },
            Threads::Workgroups([1, 1, 1]),
        )?;
        pass.dispatch(
            &self.downsweep,
            &scan_downsweep::Params { count_index, capacity },
            scan_downsweep::Buffers { counts, values, sums: &self.sums, offsets },
            self.arguments.threads(),
        )
    }
}
