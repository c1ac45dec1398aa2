//! Ways into buffers: at once or, on a device that a host lends, with the next recording.

use gpu_allocator::MemoryLocation;

use super::allocated::DeviceMemory;
use super::host::Upload;
use super::{Buffer, Gpu, SliceMut};
use crate::{Error, Result};

impl Gpu {
    /// A buffer of `len` zeroed elements.
    ///
    /// # Errors
    /// The buffer exceeds the binding limit or the memory of the device, or the device was lost.
    pub fn zeros<T: bytemuck::Pod>(&self, name: &str, len: usize) -> Result<Buffer<T>> {
        self.zeroed(self.uninit(name, len)?)
    }

    /// Zeroes a buffer.
    ///
    /// # Errors
    /// The device was lost.
    pub(crate) fn zeroed<T: bytemuck::Pod>(&self, buffer: Buffer<T>) -> Result<Buffer<T>> {
        if !buffer.is_empty() {
            self.upload(buffer.name(), Upload::Fill { target: buffer.bound(), word: 0 })?;
        }
        Ok(buffer)
    }

    /// A buffer that holds a copy of `data`.
    ///
    /// # Errors
    /// As [`Gpu::zeros`].
    pub fn buffer<T: bytemuck::Pod>(&self, name: &str, data: &[T]) -> Result<Buffer<T>> {
        let mut buffer = self.uninit(name, data.len())?;
        self.write(&mut buffer, data)?;
        Ok(buffer)
    }

    /// Overwrites the first elements of a buffer, or of a slice of one, with `data`; blocks until that is done. On a
    /// device that a host lends, the next recording begins with it instead.
    ///
    /// # Errors
    /// `data` is longer than the buffer, or the device is out of memory or lost.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn write<'a, T: bytemuck::Pod>(
        &self,
        buffer: impl Into<SliceMut<'a, T>>,
        data: &[T],
    ) -> Result<()> {
        let buffer = buffer.into();
        if data.len() > buffer.len() {
            let (name, len) = (buffer.name(), buffer.len());
            let n = data.len();
            return Err(Error::Usage(format!("buffer `{name}` holds {len} elements, not {n}")));
        }
        if data.is_empty() {
            return Ok(());
        }
        let bytes: &[u8] = bytemuck::cast_slice(data);
        let mut staging = DeviceMemory::new(
            &self.shared,
            "staging",
            bytes.len() as u64,
            MemoryLocation::CpuToGpu,
        )?;
        if let Some(mapped) = staging.mapped_mut() {
            mapped[..bytes.len()].copy_from_slice(bytes);
        }
        let (target, bytes) = (buffer.bound(), bytes.len() as u64);
        self.upload("write", Upload::Copy { staging, target, bytes })
    }

    /// Makes a change of a buffer: at once, or with the next recording where a host lends the device.
    fn upload(&self, name: &str, upload: Upload) -> Result<()> {
        match &self.shared.host {
            Some(host) => {
                host.add(upload);
                Ok(())
            }
            None => self.run(name, |pass| {
                upload.record(pass);
                Ok(())
            }),
        }
    }
}
