//! Vulkan buffers and their memory.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use ash::vk;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, AllocationScheme};
use gpu_allocator::{AllocationError, MemoryLocation};

use super::limits::whole_quads;
use super::{Bound, Retired, Shared, lock};
use crate::{Error, Result};

/// A Vulkan buffer and its memory.
#[derive(Debug)]
pub(super) struct DeviceMemory {
    pub(super) shared: Arc<Shared>,
    pub(super) raw: vk::Buffer,
    /// Taken when the buffer retires.
    pub(super) allocation: Option<Allocation>,
    name: String,
}

impl DeviceMemory {
    pub(super) fn new(
        shared: &Arc<Shared>,
        name: &str,
        bytes: u64,
        location: MemoryLocation,
    ) -> Result<Self> {
        let usage = vk::BufferUsageFlags::STORAGE_BUFFER
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

    /// From its start.
    pub(super) fn bound(&self) -> Bound {
        Bound { raw: self.raw, offset: 0, size: vk::WHOLE_SIZE }
    }
}

impl Drop for DeviceMemory {
    fn drop(&mut self) {
        if let Some(allocation) = self.allocation.take() {
            self.shared.retire(Retired::Buffer(self.raw, allocation));
            // Without work in flight nothing else would free it.
            if self.shared.last_use.load(Ordering::Acquire) == 0 {
                self.shared.collect(0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{DeviceChoice, Gpu};

    #[test]
    fn a_buffer_that_does_not_fit_says_why() {
        // A device of its own: validation has something to say about a petabyte.
        let gpu = Gpu::new(&DeviceChoice::Best).unwrap();
        let refused = DeviceMemory::new(&gpu.shared, "staging", 1 << 50, MemoryLocation::CpuToGpu);
        let error = refused.unwrap_err();
        assert!(error.to_string().contains("`staging` needs 1125899906842624 bytes"), "{error}");
        let cause = std::error::Error::source(&error).map(ToString::to_string);
        assert!(cause.is_some_and(|cause| !cause.is_empty()));
    }
}
