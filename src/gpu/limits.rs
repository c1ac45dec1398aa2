//! Limits that all kernels keep to, and so every device must support.

use std::ops::RangeInclusive;

use ash::vk;

/// The most buffers of one pass.
pub(super) const MAX_BUFFERS: u32 = 12;

/// The subgroup sizes that the kernels support.
pub(super) const SUBGROUP_SIZES: RangeInclusive<u32> = 4..=128;

/// The most shared memory of a kernel, in bytes: what Vulkan promises.
pub(super) const SHARED_MEMORY: u32 = 16_384;

/// Invocations of the largest workgroups.
pub(crate) const WORKGROUP: u32 = 256;

/// The allocated and bound size for `bytes`: never empty, as Vulkan has no empty buffers, and whole quads, for kernels
/// that read four values at a time.
pub(super) fn whole_quads(bytes: u64) -> u64 {
    bytes.max(1).saturating_add(15) / 16 * 16
}

/// Workgroups of a dispatch along either of its first two dimensions.
pub(super) fn max_workgroups(limits: &vk::PhysicalDeviceLimits) -> u32 {
    limits.max_compute_work_group_count[0].min(limits.max_compute_work_group_count[1])
}
