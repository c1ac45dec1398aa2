//! Exclusive scan and stable radix sort of arrays whose length is on the device, and the sort of each tile by itself.
//!
//! The first two are reduce-then-scan: an upsweep sums partitions of consecutive items, the last of its workgroups
//! scans the sums, and a downsweep finishes within the partitions. A decoupled look-back would need one kernel
//! instead of two, but also forward-progress guarantees that Vulkan does not provide. One subgroup owns a partition,
//! and results are bit-identical on every device and in every run. A dispatch has a subgroup for every partition of
//! the buffers' capacity; those beyond the count return at once. On a GPU, the passes of a sort after the first have
//! no upsweep of their own.

mod radix;
mod scan;
mod tiles;

pub use radix::RadixSort;
pub use scan::Scan;
pub use tiles::{TileSort, UnsortedTiles};

use crate::gpu::Buffer;
use crate::{Error, Result};

/// A number of items that is on the device only.
#[derive(Clone, Copy, Debug)]
pub struct Count<'a> {
    /// The buffer of counts.
    pub counts: &'a Buffer<u32>,
    /// The index of the count.
    pub index: u32,
}

impl Count<'_> {
    fn check(&self) -> Result<()> {
        if (self.index as usize) < self.counts.len() {
            return Ok(());
        }
        let (name, len) = (self.counts.name(), self.counts.len());
        Err(Error::Usage(format!("buffer `{name}` holds {len} counts, none at {}", self.index)))
    }
}

/// The common length of `lens` in 32 bits, for kernels.
fn common_len(what: &str, lens: &[usize]) -> Result<u32> {
    let same = lens.windows(2).all(|pair| pair[0] == pair[1]);
    let len = lens.first().and_then(|&len| u32::try_from(len).ok()).filter(|_| same);
    len.ok_or_else(|| {
        Error::Usage(format!("{what}: buffers of lengths {lens:?}; give them one length"))
    })
}
