//! Readback of buffers by submissions.

use std::marker::PhantomData;

use gpu_allocator::MemoryLocation;

use super::allocated::DeviceMemory;
use super::recorder::HOST_SUBMITS;
use super::{Bound, Gpu, Recorder, Slice};
use crate::{Error, Result};

/// A copy of a buffer that a submission brings to the host.
#[derive(Debug)]
pub struct Download<T> {
    host: DeviceMemory,
    len: usize,
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
        let mut download = None;
        self.run("read", |pass| {
            download = Some(pass.download(buffer)?);
            Ok(())
        })?;
        download.map_or_else(|| Ok(vec![]), Download::wait)
    }
}

impl Recorder<'_> {
    /// Copies a buffer, or a slice of one, as it is at this point of the recording to the host.
    ///
    /// # Errors
    /// The device is out of memory, or the recording is [`Gpu::record_into`]'s: only the host knows when the copy is
    /// done.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn download<'a, T: bytemuck::Pod>(
        &mut self,
        buffer: impl Into<Slice<'a, T>>,
    ) -> Result<Download<T>> {
        let buffer = buffer.into();
        self.download_bound(buffer.name(), buffer.bound())
    }

    /// The same for a pass's binding, where the buffer itself is not at hand.
    pub(super) fn download_bound<T: bytemuck::Pod>(
        &mut self,
        name: &str,
        bound: Bound,
    ) -> Result<Download<T>> {
        if self.value() == HOST_SUBMITS {
            return Err(Error::Usage(format!(
                "`{name}` cannot be downloaded where the host submits; once that is done, `Gpu::read` it"
            )));
        }
        let host = DeviceMemory::new(self.shared(), name, bound.size, MemoryLocation::GpuToCpu)?;
        if bound.size > 0 {
            self.copy_raw(bound, host.bound(), bound.size);
        }
        let len = bound.size as usize / size_of::<T>();
        Ok(Download { host, len, value: self.value(), element: PhantomData })
    }
}

impl<T: bytemuck::Pod> Download<T> {
    /// Waits for the submission that the copy is part of.
    ///
    /// # Errors
    /// The device was lost.
    pub fn wait(self) -> Result<Vec<T>> {
        self.host.shared.wait(self.value)?;
        let bytes = self.len * size_of::<T>();
        let mut data = vec![T::zeroed(); self.len];
        if let Some(mapped) = self.host.mapped() {
            bytemuck::cast_slice_mut(&mut data).copy_from_slice(&mapped[..bytes]);
        }
        Ok(data)
    }
}
