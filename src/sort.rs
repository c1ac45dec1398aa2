//! Exclusive scan and stable radix sort of numbers whose count lives on the device.
//!
//! Both are reduce-then-scan: an upsweep sums up partitions of consecutive items, a spine turns the sums into what
//! precedes each partition, a downsweep finishes within the partitions. Three kernels where a decoupled look-back would
//! need one, but that one needs forward-progress guarantees that Vulkan does not give. One subgroup owns a partition,
//! so no kernel waits at a barrier, and every result is the same bit for bit on every device and in every run.

mod radix;
mod scan;

pub use radix::RadixSort;
pub use scan::Scan;

use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::dispatch_arguments;
use crate::{Error, Result};

/// A number of items that the device knows and the host does not.
#[derive(Clone, Copy, Debug)]
pub struct Count<'a> {
    /// Numbers that earlier passes have written.
    pub counts: &'a Buffer<u32>,
    /// Which of them.
    pub index: u32,
}

/// Makes an indirect dispatch over a [`Count`] of items.
#[derive(Debug)]
pub struct DispatchArguments {
    pipeline: Pipeline<dispatch_arguments::Kernel>,
    arguments: Buffer<[u32; 3]>,
}

impl Count<'_> {
    /// # Errors
    /// The index is outside the counts.
    fn check(&self) -> Result<()> {
        if (self.index as usize) < self.counts.len() {
            return Ok(());
        }
        let (name, len) = (self.counts.name(), self.counts.len());
        Err(Error::Usage(format!("buffer `{name}` holds {len} counts, none at {}", self.index)))
    }
}

impl DispatchArguments {
    /// Arguments of no workgroups.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn new(gpu: &Gpu) -> Result<Self> {
        Ok(Self {
            pipeline: gpu.pipeline(&dispatch_arguments::Constants::default())?,
            arguments: gpu.zeros("dispatch_arguments", 1)?,
        })
    }

    /// Records the pass that computes the arguments, enough workgroups for `count` items but at most `capacity`.
    /// `items_per_workgroup` is at least 1. The last row of workgroups may be idle in part: kernels test their index.
    ///
    /// # Errors
    /// The count's index is outside its buffer.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        count: Count<'_>,
        items_per_workgroup: u32,
        capacity: u32,
    ) -> Result<()> {
        count.check()?;
        let items_per_workgroup = items_per_workgroup.max(1);
        pass.dispatch(
            &self.pipeline,
            &dispatch_arguments::Params { items_per_workgroup, count_index: count.index, capacity },
            dispatch_arguments::Buffers { counts: count.counts, arguments: &mut self.arguments },
            Threads::Workgroups([1, 1, 1]),
        )
    }

    /// The extent of a dispatch recorded after [`DispatchArguments::record`].
    pub fn threads(&self) -> Threads<'_> {
        Threads::Indirect(&self.arguments)
    }
}

/// The length that all of `lens` share, as the kernels take it.
///
/// # Errors
/// The lengths differ, or exceed 32 bits.
fn common_len(what: &str, lens: &[usize]) -> Result<u32> {
    let same = lens.windows(2).all(|pair| pair[0] == pair[1]);
    let len = lens.first().and_then(|&len| u32::try_from(len).ok()).filter(|_| same);
    len.ok_or_else(|| {
        Error::Usage(format!("{what}: buffers of lengths {lens:?}; give them one length"))
    })
}
