//! The memory of a buffer: a Vulkan buffer or, where that would be larger than the device creates, several.

use std::sync::Arc;

use ash::vk;
use gpu_allocator::MemoryLocation;
use rayon::prelude::*;

use super::allocated::DeviceMemory;
use super::{Bound, GpuShared};
use crate::Result;

/// One Vulkan buffer after the other, addressed as if they were one.
#[derive(Debug)]
pub(super) struct Parts {
    parts: Vec<DeviceMemory>,
    /// Bytes of each but the last.
    part: u64,
}

impl Parts {
    /// `bytes` of device memory; no window of `window` bytes from a multiple of that on is divided.
    pub(super) fn new(
        shared: &Arc<GpuShared>,
        name: &str,
        bytes: u64,
        window: u64,
    ) -> Result<Self> {
        let most = shared.properties.max_buffer_size;
        let part =
            if bytes <= most { u64::MAX } else { (most / window.max(1)).max(1) * window.max(1) };
        let begins = std::iter::successors(Some(0), |begin: &u64| {
            begin.checked_add(part).filter(|&next| next < bytes)
        });
        let create = |begin| {
            DeviceMemory::new(shared, name, part.min(bytes - begin), MemoryLocation::GpuOnly)
        };
        Ok(Self { parts: begins.map(create).collect::<Result<_>>()?, part })
    }

    pub(super) fn name(&self) -> &str {
        self.parts.first().map_or("", DeviceMemory::name)
    }

    pub(super) fn is_on(&self, shared: &Arc<GpuShared>) -> bool {
        self.parts.iter().all(|part| Arc::ptr_eq(&part.shared, shared))
    }

    /// The first Vulkan buffer.
    pub(super) fn handle(&self) -> vk::Buffer {
        self.parts.first().map_or_else(vk::Buffer::null, DeviceMemory::handle)
    }

    /// Whether windows of this size are whole.
    pub(super) fn suit(&self, window: u64) -> bool {
        self.part == u64::MAX || self.part.is_multiple_of(window.max(1))
    }

    /// Writes the first bytes from the host, before a submission uses them; returns whether it sees the memory.
    pub(super) fn write(&mut self, bytes: &[u8]) -> bool {
        let part = usize::try_from(self.part).unwrap_or(usize::MAX);
        self.parts.iter_mut().zip(bytes.chunks(part)).all(|(memory, bytes)| {
            memory.coherent_mut().map(|memory| copy(bytes, &mut memory[..bytes.len()])).is_some()
        })
    }

    /// What to bind for `size` bytes from `first` on. Bytes of several parts have the size that no device binds.
    pub(super) fn bound(&self, first: u64, size: u64) -> Bound {
        let mut pieces = self.pieces(first, size);
        let start = Bound { raw: self.handle(), offset: 0, size: 0 };
        let piece = pieces.next().unwrap_or(start);
        if pieces.next().is_some() { Bound { size: u64::MAX, ..piece } } else { piece }
    }

    /// The same bytes in pieces, each of one part.
    pub(super) fn pieces(&self, first: u64, size: u64) -> impl Iterator<Item = Bound> + use<'_> {
        let (part, mut at) = (self.part, first);
        std::iter::from_fn(move || {
            let left = (first + size).checked_sub(at).filter(|&left| left > 0)?;
            let memory = self.parts.get((at / part) as usize)?;
            let offset = at % part;
            let piece = Bound { raw: memory.handle(), offset, size: left.min(part - offset) };
            at += piece.size;
            Some(piece)
        })
    }
}

/// Copies to memory that may be new to the system, which takes longer to provide it than the copy.
fn copy(from: &[u8], to: &mut [u8]) {
    const OF_THREAD: usize = 1 << 18;
    if from.len() <= OF_THREAD {
        return to.copy_from_slice(from);
    }
    let pieces = to.par_chunks_mut(OF_THREAD).zip(from.par_chunks(OF_THREAD));
    pieces.for_each(|(to, from)| to.copy_from_slice(from));
}
