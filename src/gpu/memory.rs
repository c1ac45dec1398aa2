//! Memory of a device: total, in use, and the user's limit.

use std::sync::atomic::{AtomicU64, Ordering};

use ash::{ext, vk};
use gpu_allocator::AllocationSizes;

use super::Gpu;

/// The allocator reserves blocks that start small and double: a small model takes little memory, a large one few
/// blocks.
pub(super) fn block_sizes() -> AllocationSizes {
    const MIB: u64 = 1 << 20;
    AllocationSizes::new(16 * MIB, 8 * MIB)
        .with_max_device_memblock_size(256 * MIB)
        .with_max_host_memblock_size(64 * MIB)
}

/// The driver's report on device-local memory, of all processes together (`VK_EXT_memory_budget`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryBudget {
    /// Bytes that this process may use before it gets slow or fails, including those in use.
    pub budget: u64,
    /// Bytes in use by this process.
    pub usage: u64,
}

/// Handles for a query.
pub(super) struct BudgetQuery {
    instance: ash::Instance,
    physical: vk::PhysicalDevice,
}

impl BudgetQuery {
    /// `None` where the device does not support the extension.
    pub(super) fn new(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Option<Self> {
        // SAFETY: the handle was enumerated from the instance.
        let extensions = unsafe { instance.enumerate_device_extension_properties(physical) };
        let is_offered = |extension: &vk::ExtensionProperties| {
            extension.extension_name_as_c_str() == Ok(ext::memory_budget::NAME)
        };
        let is_offered = extensions.is_ok_and(|all| all.iter().any(is_offered));
        is_offered.then(|| Self { instance: instance.clone(), physical })
    }

    fn ask(&self) -> MemoryBudget {
        let mut budget = vk::PhysicalDeviceMemoryBudgetPropertiesEXT::default();
        let mut memory = vk::PhysicalDeviceMemoryProperties2::default().push_next(&mut budget);
        // SAFETY: the chain points at a live local, and the device offers the extension.
        unsafe {
            self.instance.get_physical_device_memory_properties2(self.physical, &mut memory);
        }
        let heaps = memory.memory_properties;
        let is_local =
            |heap: &vk::MemoryHeap| heap.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL);
        let heaps = heaps.memory_heaps_as_slice().iter();
        let told = heaps.zip(budget.heap_budget.into_iter().zip(budget.heap_usage));
        let local = told.filter(|(heap, _)| is_local(heap)).map(|(_, told)| told);
        let [budget, usage] = local
            .fold([0; 2], |[budgets, usages], (budget, usage)| [budgets + budget, usages + usage]);
        MemoryBudget { budget, usage }
    }
}

impl Gpu {
    /// The current budget of the device's memory; `None` where the driver does not report it.
    pub fn memory_budget(&self) -> Option<MemoryBudget> {
        self.shared.budget.as_ref().map(BudgetQuery::ask)
    }

    /// The bytes of all buffers, including staging, and of dropped ones that the device is not done with.
    pub fn memory_in_use(&self) -> u64 {
        self.shared.usage.now.load(Ordering::Acquire)
    }

    /// The peak of [`Gpu::memory_in_use`].
    pub fn peak_memory(&self) -> u64 {
        self.shared.usage.peak.load(Ordering::Acquire)
    }

    /// Frees the memory of dropped buffers that the device is done with; the rest is freed by the next wait.
    pub(crate) fn free_unused(&self) {
        self.shared.collect(self.shared.reached());
    }

    /// Restarts the peak from the memory in use now.
    #[doc(hidden)]
    pub fn reset_peak_memory(&self) {
        self.free_unused();
        let MemoryUsage { now, peak, .. } = &self.shared.usage;
        peak.store(now.load(Ordering::Acquire), Ordering::Release);
    }

    /// Limits [`Gpu::memory_in_use`] to `bytes`: a buffer beyond that fails as if memory were out.
    pub fn limit_memory(&self, bytes: u64) {
        self.shared.usage.limit.store(bytes, Ordering::Release);
    }
}

/// Bytes of all buffers, staging included.
#[derive(Debug)]
pub(super) struct MemoryUsage {
    now: AtomicU64,
    peak: AtomicU64,
    limit: AtomicU64,
}

impl Default for MemoryUsage {
    fn default() -> Self {
        Self { now: AtomicU64::new(0), peak: AtomicU64::new(0), limit: AtomicU64::new(u64::MAX) }
    }
}

/// Memory that exists but exceeds our limit.
#[derive(Debug, thiserror::Error)]
#[error("{now} of {limit} bytes are taken")]
pub(super) struct MemoryLimitExceeded {
    now: u64,
    limit: u64,
}

impl MemoryUsage {
    pub(super) fn admit(&self, bytes: u64) -> Result<(), MemoryLimitExceeded> {
        let (now, limit) = (self.now.load(Ordering::Acquire), self.limit.load(Ordering::Acquire));
        if now.saturating_add(bytes) > limit {
            Err(MemoryLimitExceeded { now, limit })
        } else {
            Ok(())
        }
    }

    pub(super) fn add(&self, bytes: u64) {
        let now = self.now.fetch_add(bytes, Ordering::AcqRel) + bytes;
        self.peak.fetch_max(now, Ordering::AcqRel);
    }

    pub(super) fn subtract(&self, bytes: u64) {
        self.now.fetch_sub(bytes, Ordering::AcqRel);
    }
}

#[cfg(test)]
mod tests {
    use crate::gpu::{DeviceChoice, Gpu};

    #[test]
    fn memory_counts_until_the_device_is_done_with_it_and_up_to_the_limit() {
        let gpu = Gpu::new(&DeviceChoice::Best).unwrap();
        let before = gpu.memory_in_use();
        let buffer = gpu.uninit::<u8>("buffer", 1 << 20).unwrap();
        assert!(gpu.memory_in_use() >= before + (1 << 20));
        gpu.limit_memory(before + (3 << 19));
        let refused = gpu.uninit::<u8>("another", 1 << 20).unwrap_err();
        assert_eq!(refused.exit_code(), 4, "{refused}");
        drop(buffer);
        gpu.free_unused();
        assert_eq!(gpu.memory_in_use(), before);
        gpu.uninit::<u8>("another", 1 << 20).unwrap();
    }
}
