//! Typed device buffers and the ways in and out of them.

use std::marker::PhantomData;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use ash::vk;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, AllocationScheme};
use gpu_allocator::{AllocationError, MemoryLocation};

use super::limits::whole_quads;
use super::{Bound, Gpu, Properties, Retired, Shared, SliceMut, lock};
use crate::{Error, Result};

/// An array of `T` in device memory, and its only owner: passes bind [`Slice`](super::Slice)s and
/// [`SliceMut`](super::SliceMut)s that borrow it. Dropping it frees the memory once no submission uses it.
#[derive(Debug)]
pub struct Buffer<T> {
    memory: Memory,
    len: usize,
    element: PhantomData<T>,
}

/// A Vulkan buffer and the memory behind it.
#[derive(Debug)]
pub(super) struct Memory {
    pub(super) shared: Arc<Shared>,
    raw: vk::Buffer,
    /// Taken when the buffer retires.
    pub(super) allocation: Option<Allocation>,
    name: String,
}

impl<T: bytemuck::Pod> Buffer<T> {
    /// The number of elements.
    pub fn len(&self) -> usize {
        self.len
    }

    /// True for a buffer of no elements.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The name it was created with.
    pub fn name(&self) -> &str {
        self.memory.name()
    }

    /// The Vulkan buffer, for a host application that binds it itself.
    pub fn handle(&self) -> vk::Buffer {
        self.memory.handle()
    }

    /// What its slices borrow.
    pub(super) fn memory(&self) -> &Memory {
        &self.memory
    }

    /// All of it, for copies.
    pub(super) fn bound(&self) -> Bound {
        Bound { raw: self.handle(), offset: 0, size: (self.len * size_of::<T>()) as u64 }
    }
}

impl Gpu {
    /// A buffer of `len` elements whose contents are undefined.
    ///
    /// # Errors
    /// The buffer exceeds the binding limit or the memory of the device.
    pub fn uninit<T: bytemuck::Pod>(&self, name: &str, len: usize) -> Result<Buffer<T>> {
        let bytes = (len as u64).saturating_mul(size_of::<T>() as u64);
        let Properties { name: device, max_storage_buffer_range: limit, .. } = self.properties();
        if bytes > *limit {
            let (buffer, device, limit) = (name.to_owned(), device.clone(), *limit);
            return Err(Error::BufferTooLarge { buffer, bytes, device, limit });
        }
        self.uninit_in_windows(name, len)
    }

    /// The same where passes bind windows alone: only memory limits its length.
    ///
    /// # Errors
    /// The device is out of memory.
    pub(crate) fn uninit_in_windows<T: bytemuck::Pod>(
        &self,
        name: &str,
        len: usize,
    ) -> Result<Buffer<T>> {
        let bytes = (len as u64).saturating_mul(size_of::<T>() as u64);
        let memory = Memory::new(&self.shared, name, bytes, MemoryLocation::GpuOnly)?;
        Ok(Buffer { memory, len, element: PhantomData })
    }

    /// A buffer of `len` elements of zero bits.
    ///
    /// # Errors
    /// As [`Gpu::uninit`], or the device was lost.
    pub fn zeros<T: bytemuck::Pod>(&self, name: &str, len: usize) -> Result<Buffer<T>> {
        self.zeroed(self.uninit(name, len)?)
    }

    /// A buffer with zero bits in the place of what it held.
    ///
    /// # Errors
    /// The device was lost.
    pub(crate) fn zeroed<T: bytemuck::Pod>(&self, mut buffer: Buffer<T>) -> Result<Buffer<T>> {
        let name = buffer.name().to_owned();
        self.run(&name, |pass| {
            pass.fill(&mut buffer, 0);
            Ok(())
        })?;
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

    /// Overwrites the first elements of a buffer, or of a slice of one, with `data` and waits until that is done.
    ///
    /// # Errors
    /// `data` is longer than the buffer, or the device is out of memory or lost.
    pub fn write<'a, T: bytemuck::Pod>(
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
        let mut staging =
            Memory::new(&self.shared, "staging", bytes.len() as u64, MemoryLocation::CpuToGpu)?;
        if let Some(mapped) = staging.allocation.as_mut().and_then(Allocation::mapped_slice_mut) {
            mapped[..bytes.len()].copy_from_slice(bytes);
        }
        self.run("write", |pass| {
            pass.copy_raw(staging.bound(), buffer.bound(), bytes.len() as u64);
            Ok(())
        })?;
        Ok(())
    }
}

impl Memory {
    pub(super) fn new(
        shared: &Arc<Shared>,
        name: &str,
        bytes: u64,
        location: MemoryLocation,
    ) -> Result<Self> {
        let usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::INDIRECT_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST;
        let size = whole_quads(bytes);
        let info = vk::BufferCreateInfo::default().size(size).usage(usage);
        fn out_of_memory<E>(name: &str, bytes: u64) -> impl Fn(E) -> Error
        where
            E: std::error::Error + Send + Sync + 'static,
        {
            move |cause| Error::OutOfMemory { buffer: name.to_owned(), bytes, source: cause.into() }
        }
        // SAFETY: the device is live; the buffer is bound once to memory that satisfies its requirements.
        unsafe {
            let raw =
                shared.device.create_buffer(&info, None).map_err(out_of_memory(name, size))?;
            let requirements = shared.device.get_buffer_memory_requirements(raw);
            #[cfg(feature = "testing")]
            if shared.faults.fails_allocation(name) {
                shared.device.destroy_buffer(raw, None);
                return Err(out_of_memory(name, size)(AllocationError::OutOfMemory));
            }
            let admitted = shared.usage.admit(requirements.size).or_else(|_| {
                shared.collect(shared.reached());
                shared.usage.admit(requirements.size)
            });
            if let Err(refused) = admitted {
                shared.device.destroy_buffer(raw, None);
                return Err(out_of_memory(name, size)(refused));
            }
            let desc = AllocationCreateDesc {
                name,
                requirements,
                location,
                linear: true,
                allocation_scheme: AllocationScheme::GpuAllocatorManaged,
            };
            let allocated = match lock(&shared.allocator).as_mut() {
                Some(allocator) => allocator.allocate(&desc),
                None => Err(AllocationError::OutOfMemory),
            };
            let allocation = allocated.map_err(|error| {
                shared.device.destroy_buffer(raw, None);
                out_of_memory(name, size)(error)
            })?;
            let bound =
                shared.device.bind_buffer_memory(raw, allocation.memory(), allocation.offset());
            shared.usage.add(allocation.size());
            let shared = Arc::clone(shared);
            let memory = Self { shared, raw, allocation: Some(allocation), name: name.to_owned() };
            bound.map_err(out_of_memory(&memory.name, bytes))?;
            Ok(memory)
        }
    }

    pub(super) fn name(&self) -> &str {
        &self.name
    }

    pub(super) fn handle(&self) -> vk::Buffer {
        self.raw
    }

    /// From its begin.
    pub(super) fn bound(&self) -> Bound {
        Bound { raw: self.raw, offset: 0, size: vk::WHOLE_SIZE }
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        if let Some(allocation) = self.allocation.take() {
            self.shared.retire(Retired::Buffer(self.raw, allocation));
            // Without work in flight nothing else would come by to free it.
            if self.shared.last_use.load(Ordering::Acquire) == 0 {
                self.shared.collect(0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::DeviceChoice;

    #[test]
    fn a_buffer_that_does_not_fit_says_why() {
        // A device of its own: validation has something to say about a petabyte.
        let gpu = Gpu::new(&DeviceChoice::Best).unwrap();
        let refused = Memory::new(&gpu.shared, "staging", 1 << 50, MemoryLocation::CpuToGpu);
        let error = refused.unwrap_err();
        assert!(error.to_string().contains("`staging` needs 1125899906842624 bytes"), "{error}");
        let cause = std::error::Error::source(&error).map(ToString::to_string);
        assert!(cause.is_some_and(|cause| !cause.is_empty()));
    }
}
