//! Exclusive scan and stable radix sort of numbers whose count lives on the device.
//!
//! Both are reduce-then-scan: an upsweep sums up partitions of consecutive items, the last of its workgroups turns the
//! sums into what precedes each partition (the spine), a downsweep finishes within the partitions. Two kernels where a
//! decoupled look-back would need one, but that one needs forward-progress guarantees that Vulkan does not give. One
//! subgroup owns a partition, so no kernel waits at a barrier, and every result is the same bit for bit on every device
//! and in every run. A dispatch has a workgroup for every partition that the buffers have room for; those beyond the
//! count leave at once.

mod radix;
mod scan;

pub use radix::RadixSort;
pub use scan::Scan;

use crate::gpu::Buffer;
use crate::{Error, Result};

/// A number of items that the device knows and the host does not.
#[derive(Clone, Copy, Debug)]
pub struct Count<'a> {
    /// Numbers that earlier passes have written.
    pub counts: &'a Buffer<u32>,
    /// Which of them.
    pub index: u32,
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
