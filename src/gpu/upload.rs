//! Ways into buffers: at once or, on a device that a host lends, with the next recording.

use gpu_allocator::MemoryLocation;

use super::allocated::DeviceMemory;
use super::host::PendingUpload;
use super::{Bound, Buffer, Gpu, SliceMut};
use crate::Result;

impl Gpu {
    /// A buffer of `len` zeroed elements.
    ///
    /// # Errors
    /// The buffer exceeds the binding limit or the memory of the device, or the device was lost.
    pub fn zeros<T: bytemuck::Pod>(&self, name: &str, len: usize) -> Result<Buffer<T>> {
        self.zeroed(self.uninit(name, len)?)
    }

    /// Zeroes a buffer.
    pub(crate) fn zeroed<T: bytemuck::Pod>(&self, buffer: Buffer<T>) -> Result<Buffer<T>> {
        if !buffer.is_empty() {
            let fills = buffer.pieces().map(|target| Ok(PendingUpload::Fill { target, word: 0 }));
            self.upload(buffer.name(), fills)?;
        }
        Ok(buffer)
    }

    /// A buffer that holds a copy of `data`.
    ///
    /// # Errors
    /// As [`Gpu::zeros`].
    pub fn buffer<T: bytemuck::Pod>(&self, name: &str, data: &[T]) -> Result<Buffer<T>> {
        let mut buffer = self.uninit(name, data.len())?;
        if !buffer.write_from_host(data) {
            self.write(&mut buffer, data)?;
        }
        Ok(buffer)
    }

    /// Overwrites the first elements of a buffer, or of a slice of one, with `data`; blocks until that is done. On a
    /// device that a host lends, the next recording begins with it instead.
    #[doc(hidden)]
    pub fn write<'a, T: bytemuck::Pod>(
        &self,
        buffer: impl Into<SliceMut<'a, T>>,
        data: &[T],
    ) -> Result<()> {
        let buffer = buffer.into();
        buffer.as_slice().check_len(data.len())?;
        if data.is_empty() {
            return Ok(());
        }
        let mut left: &[u8] = bytemuck::cast_slice(data);
        let copies = buffer.pieces().map_while(|target| {
            let size = left.len().min(target.size as usize);
            let (bytes, after) = left.split_at(size);
            left = after;
            (size > 0).then(|| self.staged(target, bytes))
        });
        self.upload("write", copies)
    }

    /// A copy of `bytes` to the start of `target`.
    fn staged(&self, target: Bound, bytes: &[u8]) -> Result<PendingUpload> {
        let size = bytes.len() as u64;
        let location = MemoryLocation::CpuToGpu;
        let mut staging = DeviceMemory::new(&self.shared, "staging", size, location)?;
        if let Some(mapped) = staging.mapped_mut() {
            mapped[..bytes.len()].copy_from_slice(bytes);
        }
        Ok(PendingUpload::Copy { staging, target, bytes: size })
    }

    /// Makes changes of a buffer: at once, or with the next recording where a host lends the device.
    fn upload(
        &self,
        name: &str,
        uploads: impl Iterator<Item = Result<PendingUpload>>,
    ) -> Result<()> {
        let uploads = uploads.collect::<Result<Vec<_>>>()?;
        match &self.shared.host {
            Some(host) => {
                uploads.into_iter().for_each(|upload| host.add(upload));
                Ok(())
            }
            None => self.run(name, |pass| {
                uploads.iter().for_each(|upload| upload.record(pass));
                Ok(())
            }),
        }
    }
}
