//! Readback of buffers by submissions.

use std::marker::PhantomData;
use std::sync::Arc;

use gpu_allocator::MemoryLocation;

use super::allocated::DeviceMemory;
use super::recorder::HOST_SUBMITS;
use super::{Bound, Gpu, GpuShared, Recorder, Slice};
use crate::{Error, Result};

/// A copy of a buffer that a submission brings to the host.
#[derive(Debug)]
pub struct Download<T> {
    /// One copy after the other.
    host: Vec<(DeviceMemory, u64)>,
    shared: Arc<GpuShared>,
    value: u64,
    element: PhantomData<T>,
}

impl Gpu {
    /// A copy of a buffer or a slice of one on the host, after everything submitted before.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn read<'a, T: bytemuck::Pod>(&self, buffer: impl Into<Slice<'a, T>>) -> Result<Vec<T>> {
        let buffer = buffer.into();
        self.run("read", |pass| pass.download(buffer))?.wait()
    }
}

impl Recorder<'_> {
    /// Copies a buffer, or a slice of one, as it is at this point of the recording to the host.
    #[doc(hidden)]
    pub fn download<'a, T: bytemuck::Pod>(
        &mut self,
        buffer: impl Into<Slice<'a, T>>,
    ) -> Result<Download<T>> {
        let buffer = buffer.into();
        self.download_pieces(buffer.name(), buffer.pieces())
    }

    /// The same for a pass's binding, where the buffer itself is not at hand.
    pub(super) fn download_bound<T: bytemuck::Pod>(
        &mut self,
        name: &str,
        bound: Bound,
    ) -> Result<Download<T>> {
        self.download_pieces(name, std::iter::once(bound))
    }

    fn download_pieces<T: bytemuck::Pod>(
        &mut self,
        name: &str,
        pieces: impl Iterator<Item = Bound>,
    ) -> Result<Download<T>> {
        if self.value() == HOST_SUBMITS {
            return Err(Error::Usage(format!(
                "`{name}` cannot be downloaded where the host submits; once that is done, `Gpu::read` it"
            )));
        }
        let shared = Arc::clone(self.shared());
        let mut host = vec![];
        for piece in pieces.filter(|piece| piece.size > 0) {
            let copy = DeviceMemory::new(&shared, name, piece.size, MemoryLocation::GpuToCpu)?;
            self.copy_raw(piece, copy.bound(), piece.size);
            host.push((copy, piece.size));
        }
        Ok(Download { host, shared, value: self.value(), element: PhantomData })
    }
}

impl<T: bytemuck::Pod> Download<T> {
    /// Waits for the submission that the copy is part of.
    pub fn wait(self) -> Result<Vec<T>> {
        self.shared.wait(self.value)?;
        let bytes: u64 = self.host.iter().map(|(_, size)| size).sum();
        let mut data = vec![T::zeroed(); bytes as usize / size_of::<T>()];
        let mut left = bytemuck::cast_slice_mut(&mut data);
        for (copy, size) in &self.host {
            let (part, after) = left.split_at_mut(*size as usize);
            left = after;
            if let Some(mapped) = copy.mapped() {
                part.copy_from_slice(&mapped[..part.len()]);
            }
        }
        Ok(data)
    }
}
