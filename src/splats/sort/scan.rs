//! The exclusive scan: the offset of each item's output, from the sizes of the outputs.

use super::{Count, common_len};
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{scan_downsweep, scan_upsweep};
use crate::{Error, Result};

/// Exclusive prefix sums of `u32` values, modulo 2^32.
#[derive(Debug)]
pub struct Scan {
    gpu: Gpu,
    upsweep: Pipeline<scan_upsweep::Kernel>,
    downsweep: Pipeline<scan_downsweep::Kernel>,
    partition_size: u32,
    /// (partitions)
    sums: Buffer<u32>,
    /// Workgroups of an upsweep that are done; 0 between upsweeps.
    arrivals: Buffer<u32>,
}

impl Scan {
    /// A scan with scratch memory for `capacity` values; it grows with the buffers.
    pub fn new(gpu: &Gpu, capacity: u32) -> Result<Self> {
        let partition_size = scan_upsweep::Constants::default().partition_size;
        Ok(Self {
            gpu: gpu.clone(),
            upsweep: gpu.pipeline(&scan_upsweep::Constants { partition_size })?,
            downsweep: gpu.pipeline(&scan_downsweep::Constants { partition_size })?,
            partition_size,
            sums: gpu.uninit("scan_sums", capacity.div_ceil(partition_size).max(1) as usize)?,
            arrivals: gpu.zeros("scan_arrivals", 1)?,
        })
    }

    /// Records `offsets[i] = values[0] + .. + values[i - 1]` for each i below `count`, and `total[0]`, the sum of all
    /// values. Offsets beyond the count are unchanged; a count beyond the buffers' common length is clamped to it.
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
        count.check()?;
        let partitions = capacity.div_ceil(self.partition_size).max(1);
        self.sums.grow(&self.gpu, partitions as usize)?;
        let Count { counts, index: count_index } = count;
        let (sums, arrivals) = (&mut self.sums, &mut self.arrivals);
        pass.dispatch(
            &self.upsweep,
            &scan_upsweep::Params { count_index, capacity },
            scan_upsweep::Buffers {
                counts: counts.slice(),
                values: values.slice(),
                sums: sums.slice_mut(),
                total: total.slice_mut(),
                arrivals: arrivals.slice_mut(),
            },
            Threads::Workgroups([partitions, 1, 1]),
        )?;
        pass.dispatch(
            &self.downsweep,
            &scan_downsweep::Params { count_index, capacity },
            scan_downsweep::Buffers {
                counts: counts.slice(),
                values: values.slice(),
                sums: self.sums.slice(),
                offsets: offsets.slice_mut(),
            },
            Threads::Workgroups([partitions, 1, 1]),
        )
    }
}
