//! Vulkan buffers and their memory: pieces of our own blocks, or what the host's allocator gives.

use std::ffi::CString;
use std::sync::Arc;

use ash::vk;
use ash::vk::Handle as _;
use gpu_allocator::vulkan::{
    Allocation as Piece, AllocationCreateDesc, AllocationScheme, Allocator,
};
use gpu_allocator::{AllocationError, MemoryLocation};

use super::lent::{HostAllocation, HostRequirements, MemoryFunctions};
use super::limits::whole_quads;
use super::{Bound, GpuShared, LastUse, Retired, lock};
use crate::{Error, Result};

/// A Vulkan buffer and its memory.
#[derive(Debug)]
pub(super) struct DeviceMemory {
    pub(super) shared: Arc<GpuShared>,
    pub(super) raw: vk::Buffer,
    /// Taken when the buffer retires.
    allocation: Option<Allocation>,
    name: String,
}

/// Memory of one buffer.
#[derive(Debug)]
pub(super) enum Allocation {
    Ours(Piece),
    Hosts(HostPiece),
}

/// Memory of one buffer that the host allocated.
#[derive(Debug)]
pub(super) struct HostPiece {
    allocation: HostAllocation,
    size: u64,
}

// SAFETY: a piece is memory and a cookie that any thread may give back, as the host promises.
unsafe impl Send for HostPiece {}
// SAFETY: as above; its bytes are reached through the one `DeviceMemory` that has it.
unsafe impl Sync for HostPiece {}

/// What memory of buffers comes from.
pub(super) enum MemorySource {
    Ours(Box<Allocator>),
    Hosts(MemoryFunctions),
}

// SAFETY: the host promises that its functions may be called from any thread.
unsafe impl Send for MemorySource {}

/// The host's allocator failed.
#[derive(Debug, thiserror::Error)]
pub enum HostMemoryError {
    #[error("the host's allocator returned {0:?}")]
    Refused(vk::Result),
    #[error("the host's allocator returned success, but memory that is null")]
    Null,
    #[error("the host's allocator returned offset {offset}, which is no multiple of {alignment}")]
    Misaligned { offset: u64, alignment: u64 },
    #[error("the host's allocator returned no mapped address")]
    Unmapped,
}

impl HostMemoryError {
    /// Whether the allocator gave memory that cannot be used, instead of none.
    pub fn breaks_the_contract(&self) -> bool {
        !matches!(self, Self::Refused(_))
    }
}

impl MemorySource {
    fn allocate(
        &mut self,
        name: &str,
        requirements: vk::MemoryRequirements,
        location: MemoryLocation,
    ) -> Result<Allocation, Box<dyn std::error::Error + Send + Sync>> {
        match self {
            Self::Ours(allocator) => {
                let desc = AllocationCreateDesc {
                    name,
                    requirements,
                    location,
                    linear: true,
                    allocation_scheme: AllocationScheme::GpuAllocatorManaged,
                };
                Ok(Allocation::Ours(allocator.allocate(&desc)?))
            }
            Self::Hosts(functions) => {
                let piece = host_piece(functions, name, &requirements, location)?;
                Ok(Allocation::Hosts(piece))
            }
        }
    }

    pub(super) fn free(&mut self, allocation: Allocation) {
        match (self, allocation) {
            // Freeing can only fail for an allocation of another allocator.
            (Self::Ours(allocator), Allocation::Ours(piece)) => {
                allocator.free(piece).unwrap_or_default();
            }
            (Self::Hosts(MemoryFunctions { free, user, .. }), Allocation::Hosts(piece)) => {
                // SAFETY: the host's function gets what the host's function gave, once.
                unsafe { free(*user, &piece.allocation) }
            }
            _ => {}
        }
    }
}

fn host_piece(
    functions: &MemoryFunctions,
    name: &str,
    requirements: &vk::MemoryRequirements,
    location: MemoryLocation,
) -> Result<HostPiece, HostMemoryError> {
    type Properties = vk::MemoryPropertyFlags;
    let mapped = Properties::HOST_VISIBLE | Properties::HOST_COHERENT;
    let (required, preferred) = match location {
        MemoryLocation::CpuToGpu => (mapped, Properties::empty()),
        MemoryLocation::GpuToCpu => (mapped, Properties::HOST_CACHED),
        _ => (Properties::empty(), Properties::DEVICE_LOCAL),
    };
    let name = CString::new(name).unwrap_or_default();
    let mut allocation = HostAllocation {
        memory: 0,
        offset: 0,
        mapped: std::ptr::null_mut(),
        cookie: std::ptr::null_mut(),
    };
    let MemoryFunctions { allocate, free, user } = *functions;
    let vk::MemoryRequirements { size, alignment, memory_type_bits: memory_types } = *requirements;
    let needed = HostRequirements { size, alignment, memory_types };
    let [required_flags, preferred] = [required, preferred].map(Properties::as_raw);
    // SAFETY: every pointer is to a live local; the function is the host's.
    let result = unsafe {
        allocate(
            user,
            &raw const needed,
            required_flags,
            preferred,
            name.as_ptr(),
            &raw mut allocation,
        )
    };
    let offset = allocation.offset;
    let problem = match vk::Result::from_raw(result) {
        vk::Result::SUCCESS if !offset.is_multiple_of(alignment.max(1)) => {
            HostMemoryError::Misaligned { offset, alignment }
        }
        vk::Result::SUCCESS if allocation.memory == 0 => HostMemoryError::Null,
        vk::Result::SUCCESS if !required.is_empty() && allocation.mapped.is_null() => {
            HostMemoryError::Unmapped
        }
        vk::Result::SUCCESS => return Ok(HostPiece { allocation, size }),
        result => return Err(HostMemoryError::Refused(result)),
    };
    if !matches!(problem, HostMemoryError::Null) {
        // SAFETY: the host's function gets what it just gave.
        unsafe { free(user, &allocation) };
    }
    Err(problem)
}

impl Allocation {
    pub(super) fn size(&self) -> u64 {
        match self {
            Self::Ours(piece) => piece.size(),
            Self::Hosts(piece) => piece.size,
        }
    }

    fn location(&self) -> (vk::DeviceMemory, u64) {
        match self {
            // SAFETY: the memory is bound to a buffer and not freed by hand.
            Self::Ours(piece) => (unsafe { piece.memory() }, piece.offset()),
            Self::Hosts(HostPiece { allocation, .. }) => {
                (vk::DeviceMemory::from_raw(allocation.memory), allocation.offset)
            }
        }
    }
}

fn out_of_memory<E>(name: &str, bytes: u64) -> impl Fn(E) -> Error
where
    E: Into<Box<dyn std::error::Error + Send + Sync>>,
{
    move |cause| Error::OutOfMemory { buffer: name.to_owned(), bytes, source: cause.into() }
}

impl DeviceMemory {
    pub(super) fn new(
        shared: &Arc<GpuShared>,
        name: &str,
        bytes: u64,
        location: MemoryLocation,
    ) -> Result<Self> {
        let usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST;
        let size = whole_quads(bytes);
        let info = vk::BufferCreateInfo::default().size(size).usage(usage);
        let callbacks = shared.callbacks();
        // SAFETY: the device is live; the buffer is bound once to memory that satisfies its requirements.
        unsafe {
            let raw =
                shared.device.create_buffer(&info, callbacks).map_err(out_of_memory(name, size))?;
            let requirements = shared.device.get_buffer_memory_requirements(raw);
            let allocation = match allocation(shared, name, requirements, location) {
                Ok(allocation) => allocation,
                Err(cause) => {
                    shared.device.destroy_buffer(raw, callbacks);
                    return Err(out_of_memory(name, size)(cause));
                }
            };
            let (memory, offset) = allocation.location();
            let bound = shared.device.bind_buffer_memory(raw, memory, offset);
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

    /// Its bytes; `None` where it is not host-visible.
    pub(super) fn mapped(&self) -> Option<&[u8]> {
        match self.allocation.as_ref()? {
            Allocation::Ours(piece) => piece.mapped_slice(),
            // SAFETY: the host mapped this many bytes, which nothing else writes while they are borrowed.
            Allocation::Hosts(HostPiece { allocation, size }) => unsafe {
                let mapped = std::ptr::NonNull::new(allocation.mapped)?.cast().as_ptr();
                Some(std::slice::from_raw_parts(mapped, *size as usize))
            },
        }
    }

    /// Its bytes, for the host to write before a submission uses them; `None` where that needs a flush or a copy.
    pub(super) fn coherent_mut(&mut self) -> Option<&mut [u8]> {
        match self.allocation.as_mut()? {
            Allocation::Ours(piece)
                if piece.memory_properties().contains(vk::MemoryPropertyFlags::HOST_COHERENT) =>
            {
                piece.mapped_slice_mut()
            }
            _ => None,
        }
    }

    /// Its bytes, to write.
    pub(super) fn mapped_mut(&mut self) -> Option<&mut [u8]> {
        match self.allocation.as_mut()? {
            Allocation::Ours(piece) => piece.mapped_slice_mut(),
            // SAFETY: as above, and the borrow is exclusive.
            Allocation::Hosts(HostPiece { allocation, size }) => unsafe {
                let mapped = std::ptr::NonNull::new(allocation.mapped)?.cast().as_ptr();
                Some(std::slice::from_raw_parts_mut(mapped, *size as usize))
            },
        }
    }
}

/// Memory within the limit of ours.
fn allocation(
    shared: &GpuShared,
    name: &str,
    requirements: vk::MemoryRequirements,
    location: MemoryLocation,
) -> Result<Allocation, Box<dyn std::error::Error + Send + Sync>> {
    #[cfg(debug_assertions)]
    if shared.faults.fails_allocation(name) {
        return Err(AllocationError::OutOfMemory.into());
    }
    shared.usage.admit(requirements.size).or_else(|_| {
        shared.collect(shared.reached());
        shared.usage.admit(requirements.size)
    })?;
    match lock(&shared.memory).as_mut() {
        Some(source) => source.allocate(name, requirements, location),
        None => Err(AllocationError::OutOfMemory.into()),
    }
}

impl Drop for DeviceMemory {
    fn drop(&mut self) {
        if let Some(allocation) = self.allocation.take() {
            if let Some(host) = &self.shared.host {
                host.forget(self.raw);
            }
            self.shared.retire(Retired::Buffer(self.raw, allocation));
            // Without work in flight nothing else would free it.
            if self.shared.last_use() == LastUse::default() {
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
